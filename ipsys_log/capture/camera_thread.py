"""The reader of one camera: it reads the frames, and opens the camera again after a disconnection."""

import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from ipsys_log.capture.frames import (
    CameraState,
    Clock,
    Frame,
    Heartbeat,
    LateFrameDetector,
    NodeRefusedError,
    Open,
    Say,
    SourceError,
    SourceMessage,
    mid_exposure_ns,
)
from ipsys_log.capture.nodes.centre import is_of_node
from ipsys_log.capture.nodes.wire import MARKERS_FORMAT
from ipsys_log.capture.video_files import find_size, frame_payload, is_decodable_start
from ipsys_log.errors import LogError
from ipsys_log.log.codec import decode, schema_name
from ipsys_log.messages import EVENTS_TOPIC, STAMP_UNRELIABLE, Event, Markers, RigCamera, image_topic
from ipsys_log.messages.channels import MARKERS
from ipsys_log.messages.events import NODE_AWAITED, NODE_REFUSED
from ipsys_log.plain_text import hide_password
from ipsys_log.units import NS_PER_S, format_time

# The run of markers that nodes have detected.
NODES_RUN = "nodes"

# Longest wait for the first frame of a camera.
_FIRST_FRAME_S = 10.0
# The simulator renders its images first, and a busy machine takes long for them.
_DRAW_S = 120.0
_RETRY_S, _LONGEST_RETRY_S = 0.5, 8.0
_TURN_S = 0.1
# Longest wait of a frame without a stamp for the start of the recording. A longer wait gives it a wrong time.
_EARLY_S = 0.01
# A well configured camera sends a keyframe within this number of video frames (about 20 s).
MAX_FRAMES_WITHOUT_KEYFRAME = 600
# Shortest time between two reports of missed frames of a camera.
_NAMED_EVERY_NS = NS_PER_S


def imported_run(states: Mapping[str, CameraState]) -> str | None:
    """Return the run of the markers that nodes send instead of frames; None if no camera sends markers."""
    return NODES_RUN if any(state.format == MARKERS_FORMAT for state in states.values()) else None


class Arrival(NamedTuple):
    """A message without its log time, and the time of its arrival."""

    received_ns: int
    topic: str
    publish_time_ns: int
    payload: Any
    camera: str | None = None


@dataclass(frozen=True, slots=True)
class ReaderContext:
    """The objects that the threads of all cameras share.

    ``put`` takes an arrival; it returns False if there is no room for a frame. Before ``started``, a thread
    takes only the first frame. Before ``taken``, nothing leaves the queue, and frames of nodes are discarded.
    After ``stopped``, a thread takes nothing.
    """

    open_source: Open
    clock: Clock
    put: Callable[[Arrival], bool]
    say: Say
    started: threading.Event
    taken: threading.Event
    stopped: threading.Event
    heartbeat: Heartbeat


class Pause(NamedTuple):
    """A pause of a reader: until an event, or for a time in s."""

    until: threading.Event
    seconds: float


class CameraReader:
    """The reader of one camera. A thread calls :meth:`read`; that of nodes calls it for all nodes in turn.

    Attributes
    ----------
    camera : the camera of the rig.
    state : counts and properties of the frames so far.
    fault : the error that ended the reader; None if it ended with the source.
    """

    def __init__(self, camera: RigCamera, shared: ReaderContext) -> None:
        self.state = CameraState()
        self.fault: BaseException | None = None
        self.camera, self._shared = camera, shared
        self._is_open, self._has_first_frame = threading.Event(), threading.Event()
        self._lost_ns: int | None = None
        self._lost_text = ""
        self._dropped_before = self._missed_before = self._missed_named_ns = 0
        self._said: set[str] = set()
        self._broken = False
        self._since_key = 0
        self._late = LateFrameDetector(shared.heartbeat, camera.rate_hz)
        self._is_of_node = is_of_node(camera)
        # The session and the number of the newest frame of a node before the recording.
        self._last_early: tuple[str | None, int] | None = None

    def wait_for_first_frame(self) -> None:
        """Wait for the first frame.

        Raises
        ------
        SourceError
            The camera cannot be opened, or sends nothing.
        """
        self._is_open.wait()
        # The camera of a node has its own recorder there, which may be starting.
        is_slow = self._is_of_node or str(self.camera.source).startswith("sim:")
        begun = self._has_first_frame.wait(_DRAW_S if is_slow else _FIRST_FRAME_S)
        if self.fault is not None:
            raise self.fault
        if not begun:
            raise SourceError(
                f"camera {self.camera.name}: {hide_password(str(self.camera.source))} sends no frames; "
                "check that no other program uses it"
            )

    def read(self) -> Iterator[Pause | None]:
        """Read the camera until it ends or the recording stops.

        The iterator yields None if its source has no frame now, and a pause before the next attempt.
        """
        retry_s, stopped = _RETRY_S, self._shared.stopped
        try:
            while not stopped.is_set():
                before = self.state.frames
                lost = yield from self._take_all()
                if lost is None:
                    break
                if not self._has_first_frame.is_set():
                    raise lost
                retry_s = _RETRY_S if self.state.frames > before else min(2 * retry_s, _LONGEST_RETRY_S)
                yield Pause(stopped, retry_s)
        except BaseException as fault:  # raised again in the thread that opens or iterates the cameras
            self.fault = fault
            if self._has_first_frame.is_set():
                # The other cameras may run for hours. The traceback is shown only after they have ended.
                text = (
                    f"camera {self.camera.name}: internal error ({fault!r}); this camera is no "
                    "longer recorded"
                )
                self._say("camera_failed", text)
        finally:
            self._report_lost(now=True)
            self.state.up, self.state.finished = False, True
            self._is_open.set()
            self._has_first_frame.set()

    def _take_all(self) -> Generator[Pause | None, None, SourceError | None]:
        """Take frames until the source ends (return None) or the camera disconnects (return the error)."""
        shared = self._shared
        try:
            with shared.open_source(self.camera, shared.clock, self._say_setting) as frames:
                self._is_open.set()
                for frame in frames:
                    if isinstance(frame, SourceMessage):
                        self._pass_on(frame)
                        continue
                    if shared.stopped.is_set():
                        break
                    if frame is None:
                        yield None
                        continue
                    self._count_since_key(frame)
                    if not self._is_early(frame):
                        yield from self._take(frame)
                    elif not self._has_first_frame.is_set():
                        self._note_first(frame)
        except SourceError as error:
            if self.state.up:
                self.state.up, self._lost_ns = False, shared.clock.now_ns()
                self._say("camera_lost", f"{error}; ipsys tries again")
            elif (
                isinstance(error, NodeRefusedError)
                and self._lost_ns is not None
                and str(error) != self._lost_text
            ):
                self._say(NODE_REFUSED, str(error))
            self._lost_text = str(error)
            return error
        return None

    def _pass_on(self, message: SourceMessage) -> None:
        """Put another message of the source into the stream; show the text of an event."""
        topic, payload = message
        self._shared.put(Arrival(self._shared.clock.now_ns(), topic, payload.timestamp, payload))
        if isinstance(payload, Event):
            self._shared.say(payload.text)

    def _take(self, frame: Frame) -> Iterator[Pause]:
        state, camera, now_ns = self.state, self.camera, self._shared.clock.now_ns()
        self._check_format(frame)
        if self._lost_ns is not None:
            gone_s = (now_ns - self._lost_ns) / NS_PER_S
            self._lost_ns = None
            self._say("camera_back", f"camera {camera.name} is back after {gone_s:.1f} s")
        state.up, state.format = True, frame.format
        time_ns = now_ns
        if frame.time_ns is None:
            self._report_late(now_ns)
        else:
            time_ns = mid_exposure_ns(frame.time_ns, camera)
            state.delay_s = (now_ns - time_ns) / NS_PER_S
        state.missed += frame.missed
        topic, payload = self._payload(frame, time_ns)
        self._note_size(frame, payload)
        received_ns = now_ns if frame.received_ns is None else frame.received_ns
        if not self._shared.put(Arrival(received_ns, topic, time_ns, payload, camera.name)):
            state.dropped += 1
            return
        state.first_bytes = state.first_bytes or len(frame.data)
        state.frames += 1
        state.bytes += len(frame.data)
        if frame.time_ns is None and self._late.since_ns is not None:
            self._report_caught_up()
        self._report_lost()
        self._has_first_frame.set()
        # A frame with a stamp waits until the slowest camera has started: it is only delayed. A frame
        # without a stamp must not wait: its arrival is its time. A node sends on meanwhile.
        while (
            frame.time_ns is not None
            and not self._is_of_node
            and not self._shared.started.is_set()
            and not self._shared.stopped.is_set()
        ):
            yield Pause(self._shared.started, _TURN_S)

    def _note_first(self, frame: Frame) -> None:
        """Store the properties of a first frame that is not recorded."""
        state = self.state
        state.up, state.format, state.first_bytes = True, frame.format, len(frame.data)
        _, payload = self._payload(frame, self._shared.clock.now_ns())
        self._note_size(frame, payload)
        self._has_first_frame.set()

    def _payload(self, frame: Frame, time_ns: int) -> tuple[str, Any]:
        """Return the topic and the payload of a frame, or of the markers that a node sends instead."""
        name = self.camera.name
        if frame.format != MARKERS_FORMAT:
            return image_topic(name), frame_payload(time_ns, name, frame.data, frame.format)
        try:
            markers = decode(schema_name(Markers), frame.data)
        except LogError as error:
            raise SourceError(f"camera {name}: its node sends damaged markers ({error})") from error
        keyed = replace(markers, timestamp=time_ns, node_session=frame.session, node_frame=frame.number)
        return MARKERS.topic_of(NODES_RUN, name), keyed

    def _is_early(self, frame: Frame) -> bool:
        """Return whether a frame arrived before the recording began, or depends on a frame that did.

        The caller discards such frames. The time of a frame without a stamp is its arrival, so the frame must
        not wait until the recording begins, except the first one. Files and the simulator give stamps, and
        wait. The frames of nodes must not wait either: positions would be late for long.
        """
        if self._is_of_node:
            is_early = self._precedes_recording(frame)
        elif not self._has_first_frame.is_set():
            return False
        else:
            is_early = frame.time_ns is None and not self._shared.started.wait(_EARLY_S)
        if is_early:
            self._broken = True
            return True
        self._broken = self._broken and 0 < self._since_key < MAX_FRAMES_WITHOUT_KEYFRAME
        return self._broken

    def _precedes_recording(self, frame: Frame) -> bool:
        """Return whether a frame of a node arrived before the recording, or is older than one that did.

        A node sends older frames again, after a gap. The log would have some of them, and others not.
        """
        key = frame.session, frame.number or 0
        if self._shared.taken.is_set():
            return self._last_early is not None and key[0] == self._last_early[0] and key < self._last_early
        if self._last_early is None or key[0] != self._last_early[0] or key > self._last_early:
            self._last_early = key
        return True

    def _count_since_key(self, frame: Frame) -> None:
        """Report a video without keyframes: after a dropped frame, decoding cannot start again."""
        self._since_key = 0 if is_decodable_start(frame) else self._since_key + 1
        if self._since_key == MAX_FRAMES_WITHOUT_KEYFRAME:
            text = (
                f"camera {self.camera.name}: no keyframe in {MAX_FRAMES_WITHOUT_KEYFRAME} frames; "
                "frames after a skipped or damaged one cannot be decoded until the next keyframe; "
                "set its keyframe interval (GOP) to 1 or 2 s"
            )
            self._say_once("no_keyframes", text)

    def _check_format(self, frame: Frame) -> None:
        """Check that a frame has the format of the earlier frames: a channel of a log holds one format."""
        before, name = self.state.format, self.camera.name
        if before in (None, frame.format):
            return
        text = (
            f"camera {name}: its format changed from {before} to {frame.format}, but a log can hold only "
            f"one; set the camera to {before}, or start a new recording"
        )
        if not self.state.up:
            self._say_once("camera_lost", f"{text}; ipsys tries again")
        raise SourceError(text)

    def _note_size(self, frame: Frame, payload: Any) -> None:
        """Store the size of the images, and report a change; of a video, only the first size is read."""
        before = self.state.size_px
        if before is not None and frame.format not in ("jpeg", MARKERS_FORMAT):
            return
        is_detected = isinstance(payload, Markers)
        size_px = (payload.width, payload.height) if is_detected else find_size(frame)
        if size_px is None or size_px == before:
            return
        self.state.size_px = size_px
        if before is not None:
            new, old = (f"{width} x {height} px" for width, height in (size_px, before))
            text = f"camera {self.camera.name}: its image size changed from {old} to {new}; a calibration "
            self._say("camera_size", f"{text}is valid for one size; set it back")

    def _report_lost(self, now: bool = False) -> None:
        """Report the frames lost since the last report."""
        state, name = self.state, self.camera.name
        if dropped := state.dropped - self._dropped_before:
            self._dropped_before = state.dropped
            self._say("frames_dropped", f"{dropped} frames of camera {name} dropped: the disk is too slow")
        time_ns = self._shared.clock.now_ns()
        missed = state.missed - self._missed_before
        if missed and (now or time_ns - self._missed_named_ns >= _NAMED_EVERY_NS):
            self._missed_before, self._missed_named_ns = state.missed, time_ns
            self._say(
                "frames_missed",
                f"{missed} frames of camera {name} are missing: the camera or its driver lost them",
            )

    def _report_late(self, now_ns: int) -> None:
        """Write an event before the first late frame without a stamp."""
        stall = self._late.take(now_ns)
        if stall is None:
            return
        text = (
            f"camera {self.camera.name}: the recorder was suspended for "
            f"{(stall.end_ns - stall.start_ns) / NS_PER_S:.1f} s; its frames arrive late now, with "
            "wrong times"
        )
        self._say(STAMP_UNRELIABLE, text, stall.start_ns)

    def _report_caught_up(self) -> None:
        """Write an event after the last late frame, with the range of the wrong times."""
        start_ns, end_ns = self._late.since_ns, self._late.last_ns
        if start_ns is None or end_ns is None or not self._late.has_caught_up():
            return
        text = (
            f"camera {self.camera.name}: its frames arrive in time again; the frames from "
            f"{format_time(start_ns)} to {format_time(end_ns)} UTC were late"
        )
        self._say(STAMP_UNRELIABLE, text, start_ns, end_ns)

    def _say_setting(self, text: str) -> None:
        """Report a setting that the camera refused, once, also if the camera is opened several times.

        A node has the settings of its camera, and its centre reports only that it waits for the node.
        """
        self._say_once(NODE_AWAITED if self._is_of_node else "camera_setting", text)

    def _say_once(self, kind: str, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(kind, text)

    def _say(self, kind: str, text: str, start_ns: int | None = None, end_ns: int | None = None) -> None:
        """Put an event of this camera into the stream, and show its text at once."""
        now_ns = self._shared.clock.now_ns()
        event = Event(now_ns, kind, text, self.camera.name, None, start_ns, end_ns)
        self._shared.put(Arrival(now_ns, EVENTS_TOPIC, now_ns, event))
        self._shared.say(text)
