"""Payloads of the provenance: the records of a run, of a cut and of a merge."""

from __future__ import annotations

from dataclasses import dataclass, field

from ipsys_log.messages.message import Floats, Mat33, TimeNs
from ipsys_log.messages.rig import Rig

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
