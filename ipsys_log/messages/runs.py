"""Payload of the provenance: the record of a run."""

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
