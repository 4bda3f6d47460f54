"""Pieces of a run: the frames of one camera between two resets, computed alone and merged in log order.

:func:`compute_piece` may run in any process, and pieces may finish in any order. :func:`merge_pieces` gives
the messages of the run, with the same bytes as one process without pieces. Neither starts a process.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.stream import WiredStage, derive
from ipsys_log.engine.view import given_settings, left_out_frames
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import CameraCalibration, CompressedVideo, Encoded, Message, Rig
from ipsys_log.messages.channels import ANNOTATIONS, RIG
from ipsys_log.messages.stage import Pieces, Resets
from ipsys_log.stages import load_stage
from ipsys_log.units import format_time

if TYPE_CHECKING:
    from ipsys_log.engine.graph import Task

# A smaller run is done before workers have started, and opened the log.
_MIN_FRAMES = 1_000
_MIN_PIECES = 4
# Number of pieces for each worker that may be finished before the pieces in front of them.
_AHEAD = 2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PieceRun:
    """The part of a run that all its pieces have in common. It can be pickled.

    Attributes
    ----------
    paths : the logs that have some of the topics.
    versions : of each of these logs, what changes with its content.
    stage, parameters : of the run.
    topics : the topics that the run reads.
    rig, lenses : they replace those of the logs; intrinsics by camera.
    skipped : log times in ns of the frames that the run leaves out.
    """

    paths: tuple[LogLocation, ...]
    stage: str
    parameters: Mapping[str, str]
    topics: tuple[str, ...]
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration]
    skipped: frozenset[int] = frozenset()
    versions: tuple[object, ...] = ()

    @classmethod
    def of_task(cls, task: Task, session: Session) -> PieceRun:
        """Return what the pieces of a task need."""
        # A new log for the results, which has no topics yet, exists only in this process.
        topics = set(task.topics)
        readers = [reader for reader in session.readers if reader.channels.keys() & topics]
        return cls(
            paths=tuple(reader.path for reader in readers),
            stage=task.stage.name,
            parameters=dict(task.parameters),
            topics=task.topics,
            rig=task.rig,
            lenses=dict(task.lenses),
            skipped=frozenset(left_out_frames(session, task)),
            versions=tuple(reader.view.identity()[1] for reader in readers),
        )

    def load(self) -> Pieces:
        """Return how the stage processes pieces."""
        pieces = load_stage(self.stage).pieces
        assert pieces is not None, f"{self.stage} has no pieces"
        return pieces(self.parameters)

    @contextmanager
    def open(self) -> Iterator[Callable[[Piece], PieceResult]]:
        """Open the logs; yield the function that computes a piece."""
        with Session(self.paths) as session:
            check_versions(session, self)
            yield partial(compute_piece, session, self)


class Piece(NamedTuple):
    """The frames of a camera with ``start_ns`` <= log time < ``end_ns``."""

    camera: str
    start_ns: int
    end_ns: int

    def __str__(self) -> str:
        return f"the piece of {self.camera} that begins at {format_time(self.start_ns)}"


class FrameResult(NamedTuple):
    """The publish time of a frame in ns, and the payloads that were made from it, some of them encoded."""

    publish_time_ns: int
    payloads: tuple[Any, ...]


class PieceResult(NamedTuple):
    """The results of the frames of a piece, in log order, up to the frame with an ``error``."""

    frames: list[FrameResult]
    error: IpsysError | None = None


class PieceFrames(NamedTuple):
    """The frames of all cameras in log order: log times in ns and places in ``cameras``, (N,) each."""

    cameras: Sequence[str]
    times_ns: NDArray[np.int64]
    places: NDArray[np.int64]


class PiecePlan(NamedTuple):
    """The division of a run into pieces, in the order of their first frames."""

    run: PieceRun
    frames: PieceFrames
    pieces: list[Piece]

    def ahead(self, workers: int) -> int:
        """Return how many pieces may be in work or finished before the pieces in front of them are used."""
        return _AHEAD * workers + len(self.frames.cameras)

    @property
    def is_long(self) -> bool:
        """True if several processes compute the run faster than one."""
        return len(self.frames.times_ns) >= _MIN_FRAMES and len(self.pieces) >= _MIN_PIECES


class PieceWorkers(Protocol):
    """The computation of the pieces of a run outside of this process.

    Attributes
    ----------
    divides : False if this process computes all runs itself.
    first_only : True if a replay ends after its first stage: the later ones are computed elsewhere.
    """

    @property
    def divides(self) -> bool: ...

    @property
    def first_only(self) -> bool: ...

    def prepare(self, plan: PiecePlan, /) -> None:
        """Begin to prepare the computation of a plan; return before the preparation is complete."""
        ...

    def compute(self, plan: PiecePlan, /) -> Iterator[PieceResult]:
        """Yield the results of the pieces in the order of the plan."""
        ...


class DividedRun(NamedTuple):
    """The plan of a long run, and the workers that compute its pieces."""

    plan: PiecePlan
    workers: PieceWorkers


def divide_run(task: Task, session: Session, workers: PieceWorkers) -> DividedRun | None:
    """Divide the run of a task into pieces for workers; None if this process computes it faster, or must."""
    plan = plan_pieces(task, session) if workers.divides else None
    return DividedRun(plan, workers) if plan is not None and plan.is_long else None


def plan_pieces(task: Task, session: Session) -> PiecePlan | None:
    """Divide the run of a task into pieces; None if its stage, or a video, needs all earlier frames."""
    # Markers of nodes, which the stage passes on, are in no piece.
    is_divided = task.stage.pieces is not None and not task.inputs
    frames = order_frames(session, task.topics) if is_divided else None
    if frames is None:
        return None
    run = PieceRun.of_task(task, session)
    return PiecePlan(run, frames, split_frames(frames, run.load().resets))


def order_frames(session: Session, topics: Iterable[str]) -> PieceFrames | None:
    """Return the frames of some topics; None if there are none, or if one topic is a video."""
    wanted = set(topics)
    cameras = [camera for camera, topic in sorted(session.images.items()) if topic in wanted]
    images = [session.images[camera] for camera in cameras]
    if not images or any(session.has_payload(topic, CompressedVideo) for topic in images):
        return None
    return PieceFrames(cameras, *session.order(images))


def split_frames(frames: PieceFrames, resets: Resets) -> list[Piece]:
    """Return the pieces with at least one frame, in the order of their first frames."""
    firsts: list[tuple[int, Piece]] = []
    for place, camera in enumerate(frames.cameras):
        indices = np.flatnonzero(frames.places == place)
        times_ns = frames.times_ns[indices]
        row = 0
        while row < len(indices):
            number = resets.number(camera, int(times_ns[row]))
            piece = Piece(camera, resets.start_ns(camera, number), resets.start_ns(camera, number + 1))
            firsts.append((int(indices[row]), piece))
            row = int(np.searchsorted(times_ns, piece.end_ns))
    return [piece for _, piece in sorted(firsts)]


def check_versions(session: Session, run: PieceRun) -> None:
    """Check that open logs are still those of a run."""
    for reader, version in zip(session.readers, run.versions, strict=True):
        if reader.view.identity()[1] != version:
            raise IpsysError(f"{reader.path} changed while it was read: run the command again")


def compute_piece(session: Session, run: PieceRun, piece: Piece) -> PieceResult:
    """Compute one piece from the open logs of a run; an error of the input is a part of the result."""
    step = run.load().step()
    topic = session.images[piece.camera]
    frames: list[FrameResult] = []
    try:
        for message in _messages(session, run, piece):
            is_left_out = message.topic == topic and message.log_time_ns in run.skipped
            payloads = () if is_left_out else tuple(map(_encode_drawing, step(message)))
            if message.topic == topic:
                frames.append(FrameResult(message.publish_time_ns, payloads))
    except IpsysError as error:
        return PieceResult(frames, error)
    return PieceResult(frames)


def _encode_drawing(payload: Any) -> Any:
    """Encode what only viewers read: its many small parts would go to another process one by one."""
    kind = type(payload)
    return Encoded(kind, encode(payload)) if kind in ANNOTATIONS.payloads else payload


def _messages(session: Session, run: PieceRun, piece: Piece) -> Iterator[Message]:
    """Yield the rig and the intrinsics that hold before a piece, and then the messages of the piece."""
    yield from given_settings(session, run.rig, run.lenses)
    of_camera = session.calibrations.get(piece.camera)
    settings = [topic for topic in run.topics if topic in (of_camera, *session.topics(RIG))]
    for topic in settings:
        message = session.latest(topic, piece.start_ns)
        if message is not None:
            yield message
    images = session.images[piece.camera]
    yield from session.messages([*settings, images], piece.start_ns, piece.end_ns)


def merge_pieces(
    wired: WiredStage,
    plan: PiecePlan,
    results: Iterable[PieceResult],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[Message]:
    """Yield the messages of a run in log order.

    Parameters
    ----------
    wired : gives the topics of the payloads; its step is not used.
    results : of the pieces of the plan, in their order.

    Raises
    ------
    IpsysError
        The first error of the pieces, in log order.
    """
    frames, reports = plan.frames, plan.run.load().reports()
    pieces = iter(results)
    waiting: list[deque[FrameResult]] = [deque() for _ in frames.cameras]
    errors: list[IpsysError | None] = [None for _ in frames.cameras]
    total = len(frames.times_ns)
    progress(0, total)
    order = zip(frames.times_ns.tolist(), frames.places.tolist(), strict=True)
    for done, (time_ns, place) in enumerate(order, 1):
        while not waiting[place]:
            if (error := errors[place]) is not None:
                raise error
            result = next(pieces)
            waiting[place].extend(result.frames)
            errors[place] = result.error
        publish_time_ns, payloads = waiting[place].popleft()
        frame = Message("", time_ns, publish_time_ns, None, frames.cameras[place])
        yield from derive(wired, frame, reports(frame.camera, payloads))
        progress(done, total)
