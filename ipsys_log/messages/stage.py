"""The row of a stage: the channels that it reads and writes, its plan and its execution, and its resets."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from ipsys_log.messages.channels import MODEL, Channel
from ipsys_log.messages.message import Message
from ipsys_log.messages.rig import CameraCalibration, Rig

# A step turns a message into payloads; it is called with the messages in log order.
Step = Callable[[Message], Iterable[Any]]
# Turns the payloads of a frame of a camera into those that go into the log; called in log order.
Reports = Callable[[str | None, Iterable[Any]], Iterable[Any]]
# Called with the number of steps done, and the number of all steps.
Progress = Callable[[int, int], None]


class StageView(Protocol):
    """The view of a stage on a log: its channels; derived ones come from the runs that the stage reads."""

    @property
    def rig(self) -> Rig | None:
        """Return the rig that replaces the one of the log, if any."""

    @property
    def cameras(self) -> Collection[str]:
        """Return the names of the cameras with images."""

    @property
    def lenses(self) -> Collection[str]:
        """Return the names of the cameras with intrinsics, from the log or from the user."""

    def calibrations(self) -> dict[str, CameraCalibration]:
        """Return the first intrinsics of each camera, from the log or from the user."""

    def run(self, channel: Channel, /) -> str:
        """Return the run that the stage reads of a derived channel; "" if there is none."""

    def messages(self, *channels: Channel) -> Iterator[Message]:
        """Yield the messages of some channels in log order."""

    def payloads(self, channel: Channel, /) -> list[Any]:
        """Return the payloads of a channel."""

    def count(self, *channels: Channel) -> int:
        """Return the number of messages of some channels."""

    def last_ns(self, *channels: Channel) -> int:
        """Return the publish time of the last message of some channels."""

    def newest(self, channel: Channel, /) -> str:
        """Return the newest complete run with a channel; "" if there is none."""

    def copied(self, channel: Channel, /) -> Iterator[tuple[str, Any]]:
        """Yield the complete runs with a channel, newest first, each with its last payload."""


class Timed(NamedTuple):
    """A payload of a stage that needs the whole log, with the log time of the message that it belongs to."""

    log_time_ns: int
    payload: Any


class Pieces(NamedTuple):
    """The division of the work of a causal stage: frames of a camera between two resets are one piece.

    Attributes
    ----------
    resets : the bounds of the pieces.
    step : makes the step for one piece; its first messages are the rig and the intrinsics.
    reports : makes the function that sees the payloads of all pieces, in log order.
    """

    resets: Resets
    step: Callable[[], Step]
    reports: Callable[[], Reports]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The plan of one run of a stage: everything on which its result depends.

    Attributes
    ----------
    run : its name, if this name is free.
    parameters : the parameters on which the result depends, as in the record of the run.
    reads : the channels of the row that a run with these parameters reads.
    step : makes the step of a causal stage for a run of a given name; or
    compute : returns the payload of a stage that needs the whole log, or :class:`Timed` payloads: a list or
        an iterator.
    notes : remarks for the user; ``compute`` may add some.
    """

    run: str
    parameters: Mapping[str, str]
    reads: tuple[Channel, ...]
    step: Callable[[str], Step] | None = None
    compute: Callable[[Progress], Any] | None = None
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stage:
    """The row of a stage: everything that the rest of the program knows about the stage.

    Attributes
    ----------
    name : the name in its command and its records.
    versions : of the stage and of its methods, by name. A version rises by one with each change of the output
        for the same input.
    reads : channels that its steps get; recorded channels completely, derived channels of one run.
    writes : channels; the first is its purpose. Each has other payload types than the others.
    plan : plans a run from a log and the options of the user, by name; or returns the name of an existing run
        to use instead, "" if there is none.
    rig_part : the part of the rig on which the result depends, by its method or model.
    method : the method or model of a run, from its parameters and its view; "" for a stage without methods.
    causal : it has steps: live tracking can run it.
    per_camera : a step sees the messages of one camera only, so that cameras can be processed in parallel.
    in_threads : it works outside of Python: one thread for each camera is faster.
    of_model : each model has its own run of this stage, and of the stages that read it.
    on_demand : it runs only if the user names it, or a stage that needs it.
    pieces : the pieces of a run with these parameters, if its frames can be processed in pieces.
    """

    name: str
    versions: Mapping[str, int]
    reads: tuple[Channel, ...]
    writes: tuple[Channel, ...]
    plan: Callable[[StageView, Mapping[str, str]], Plan | str]
    rig_part: Callable[[Rig, str], Any]
    method: Callable[[Mapping[str, str], StageView], str] = lambda parameters, view: ""
    causal: bool = True
    per_camera: bool = True
    in_threads: bool = False
    of_model: bool = False
    on_demand: bool = False
    pieces: Callable[[Mapping[str, str]], Pieces] | None = None

    def __repr__(self) -> str:
        return f"<stage {self.name}>"

    def channel_for(self, payload: type) -> Channel:
        """Return the channel that the stage writes payloads of a type to."""
        return next(channel for channel in self.writes if payload in channel.payloads)


def model_read(_parameters: Mapping[str, str], view: StageView) -> str:
    """Return the method of a stage that reads a model: the name of the model, "" without one."""
    models = view.payloads(MODEL)
    return models[-1].name if models else ""


@dataclass(frozen=True, slots=True)
class Resets:
    """The instants at which a stage clears its memory of each camera, at absolute multiples of a period.

    The instants depend on the log time and the name of the camera only. So a cut keeps them, and the frames
    of a camera between two resets can be processed without the frames before them.

    Examples
    --------
    >>> resets = Resets(30_000_000_000)
    >>> number = resets.number("red", 1_700_000_000_000_000_000)
    >>> resets.start_ns("red", number) <= 1_700_000_000_000_000_000 < resets.start_ns("red", number + 1)
    True
    """

    period_ns: int

    def number(self, camera: str, log_time_ns: int) -> int:
        """Return the number of the last reset of a camera at or before a log time in ns."""
        return (log_time_ns - self._first_ns(camera)) // self.period_ns

    def start_ns(self, camera: str, number: int) -> int:
        """Return the log time in ns of a reset of a camera."""
        return self._first_ns(camera) + number * self.period_ns

    def _first_ns(self, camera: str) -> int:
        # Simultaneous searches of all cameras would take too long for live tracking. The name of a camera,
        # unlike its number in the rig, stays the same in all parts of a log.
        return zlib.crc32(camera.encode()) * self.period_ns >> 32
