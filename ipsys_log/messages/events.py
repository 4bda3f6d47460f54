"""Payloads about the log itself: events, latencies, clocks of nodes, and records of runs, cuts, merges."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from ipsys_log.messages.message import Floats, Mat33, TimeNs
from ipsys_log.messages.rig import Rig

# The kind of an event whose timestamp is the log time of a frame that live processing skipped.
FRAME_SKIPPED = "frame_skipped"
# The kind of an event for late frames of a camera; these frames have their time of arrival.
STAMP_UNRELIABLE = "stamp_unreliable"
# The kind of an event for a camera whose calibration file did not state the lens model.
ASSUMED_MODEL = "assumed_lens_model"
# The kind of an event for a camera whose markers contradict its intrinsics, or a marker its length.
CALIBRATION_CONTRADICTED = "calibration_contradicted"
# The kind of an event for a camera that was knocked during a live recording.
CAMERA_MOVED = "camera_moved"
# The kinds of events of a camera that moved slowly, of one whose new pose is in use, of a marker that was
# moved on its robot or from its place, and of a clock that jumped.
CAMERA_DRIFTED, CAMERA_REPAIRED = "camera_drifted", "camera_repaired"
MARKER_MOVED, CLOCK_JUMPED = "marker_moved", "clock_jumped"
# The kinds of events of the watch over the cameras.
WATCHED = frozenset((CAMERA_MOVED, CAMERA_DRIFTED, CAMERA_REPAIRED, MARKER_MOVED, CLOCK_JUMPED))
# The kind of an event for a model whose cameras place the same robot far apart.
MODEL_CONTRADICTED = "model_contradicted"
# The kinds of events for a marker whose corners contradict its height in the rig, and for a tilted marker
# whose camera point assumes that it is parallel to the image.
CONTRADICTED_HEIGHT, TILTED_MARKER = "contradicted_height", "tilted_marker"
# The kinds of events for a camera whose images are mirrored, and for prints that are no markers of the rig.
MIRRORED, OTHER_PRINTS = "mirrored_camera", "other_prints"
# The kind of an event for a marker that is not where the rig places it on its body.
LOOSE_MARKER = "loose_marker"
# The kind of an event for a marker of a body that is not level, with a model that has no pose of it.
FREE_BODY = "free_body"
# The kinds of events for inputs that the measurements of the log contradict.
CONTRADICTIONS = frozenset(
    (CALIBRATION_CONTRADICTED, CONTRADICTED_HEIGHT, TILTED_MARKER, MIRRORED, OTHER_PRINTS, LOOSE_MARKER)
)
# The kinds of events for the first answers of the node of a camera, and for a long wait for them.
NODE_ANSWERS, NODE_AWAITED = "node_answers", "node_awaited"
# The kind of an event for a node whose frames are not recorded: a second one, or one of another version.
NODE_REFUSED = "node_refused"
# The kind of an event for messages from a damaged part of the log, which no CRC confirms.
DAMAGED = "damaged"
# The kinds of events of an operator: a remark at an instant, and the start and the end of a named segment.
MARK, SEGMENT_STARTED, SEGMENT_ENDED = "mark", "segment_started", "segment_ended"
OPERATOR_KINDS = frozenset((MARK, SEGMENT_STARTED, SEGMENT_ENDED))


@dataclass(frozen=True, slots=True)
class Event:
    """An event that a reader of the log must know, such as a corrupt frame.

    ``start`` and ``end`` are the first and the last time of the frames that an event of kind
    ``stamp_unreliable`` affects; without ``end``, the last time is not known yet. ``segment`` is the name of
    the segment that an event of kind ``segment_started`` or ``segment_ended`` begins or ends; the second has
    its ``start`` and ``end``.
    """

    timestamp: TimeNs
    kind: str
    text: str
    camera: str | None = None
    marker_id: int | None = None
    start: TimeNs | None = None
    end: TimeNs | None = None
    segment: str | None = None


def skipped_frames(events: Iterable[Event]) -> set[int]:
    """Return the log times in ns of the frames that live processing skipped."""
    return {event.timestamp for event in events if event.kind == FRAME_SKIPPED}


@dataclass(frozen=True, slots=True)
class Latency:
    """The times at which the steps from a frame to its positions were done, by the wall clock.

    This is telemetry: no stage reads it.
    """

    timestamp: TimeNs
    camera: str
    received: TimeNs
    detected: TimeNs
    located: TimeNs
    fused: TimeNs
    published: TimeNs


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """The clock of the node of a camera against the clock of the centre, which records.

    ``timestamp`` is by the clock of the centre. ``session`` is new at each start of the node. At
    ``node_time``, ``offset_ns`` is the time of the centre minus the time of the node; ``drift`` is its change
    in s/s. The true offset lies within ``bound_ns`` of it, whatever the delays of the network are.
    """

    timestamp: TimeNs
    camera: str
    session: str
    node_time: TimeNs
    offset_ns: int
    drift: float
    bound_ns: int
    exchanges: int


# The stage in the record of a run that was read from files of another program.
IMPORTED = "import"


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """The camera intrinsics that a run used, without their time."""

    camera: str
    width: int
    height: int
    distortion_model: str
    d: Floats
    k: Mat33


@dataclass(frozen=True, slots=True)
class ChannelRead:
    topic: str
    messages: int
    hash: str


@dataclass(frozen=True, slots=True)
class ChannelWritten:
    topic: str
    messages: int


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    timestamp: TimeNs
    run: str
    stage: str
    parameters: dict[str, str] = field(default_factory=dict)
    fingerprint: dict[str, str] = field(default_factory=dict)
    rig: Rig | None = None
    lenses: tuple[Lens, ...] = ()
    input_runs: tuple[str, ...] = ()
    inputs: tuple[ChannelRead, ...] = ()
    outputs: tuple[ChannelWritten, ...] = ()
    number: int = 0


@dataclass(frozen=True, slots=True)
class ChannelCut:
    """A channel before a cut (``messages``, ``hash``) and after it (``kept``, ``kept_hash``).

    ``left_out`` says that the options exclude the whole channel. In a merged log, ``shared`` says that the
    channel also has messages of other logs, or was changed.
    """

    topic: str
    messages: int
    hash: str
    kept: int
    kept_hash: str | None = None
    left_out: bool = False
    shared: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """The record of a cut: the names of the logs that were cut, the options, and each channel."""

    timestamp: TimeNs
    logs: tuple[str, ...] = ()
    options: dict[str, str] = field(default_factory=dict)
    channels: tuple[ChannelCut, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class MergedLog:
    """A log in a merged log: its name, the offset of its times, and its channels there.

    ``offset_ns`` was added to all times of the log; ``offset_sigma_s`` is the standard deviation of an
    estimated offset. ``renamed_runs``, in merged logs of older versions, are the new names of runs by their
    old names.
    """

    name: str
    offset_ns: int = 0
    offset_sigma_s: float | None = None
    channels: tuple[ChannelCut, ...] = ()
    renamed_runs: dict[str, str] = field(default_factory=dict)

    @property
    def logs(self) -> tuple[str, ...]:
        """The name of the log, as in the record of a cut."""
        return (self.name,)


@dataclass(frozen=True, slots=True, eq=False)
class Merge:
    """The record of a merge: the logs in their order."""

    timestamp: TimeNs
    logs: tuple[MergedLog, ...] = ()
