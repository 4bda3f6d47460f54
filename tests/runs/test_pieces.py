"""Pieces of a run: their bounds, and the merge of their results with the bytes of one process."""

import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.engine.execute import compute_messages, one_blas_thread
from ipsys_log.engine.graph import Task, plan_stage, writer_of
from ipsys_log.engine.output import write_log
from ipsys_log.engine.pieces import (
    Piece,
    PieceFrames,
    PieceResult,
    PieceRun,
    compute_piece,
    merge_pieces,
    order_frames,
    plan_pieces,
    split_frames,
)
from ipsys_log.engine.stream import wire
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import PAYLOADS, encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message, Rig, RigMarker, kind_of
from ipsys_log.messages.channels import MARKERS
from ipsys_log.messages.stage import Resets
from ipsys_log.units import NS_PER_S

Row = tuple[str, int, int, bytes]

times = st.lists(st.integers(0, 200 * NS_PER_S), max_size=60)


@given(times, times, st.integers(NS_PER_S // 10, 40 * NS_PER_S))
def test_each_frame_is_in_exactly_one_piece(red: list[int], white: list[int], period_ns: int) -> None:
    frames = _frames(red, white)
    resets = Resets(period_ns)
    pieces = split_frames(frames, resets)
    for place, camera in enumerate(frames.cameras):
        for time_ns in frames.times_ns[frames.places == place].tolist():
            assert sum(p.camera == camera and p.start_ns <= time_ns < p.end_ns for p in pieces) == 1
    assert all(piece.end_ns - piece.start_ns == period_ns for piece in pieces)
    firsts = [
        next(
            row
            for row, (time_ns, place) in enumerate(zip(frames.times_ns, frames.places, strict=True))
            if frames.cameras[place] == piece.camera and piece.start_ns <= time_ns < piece.end_ns
        )
        for piece in pieces
    ]
    assert firsts == sorted(firsts)


@given(times, st.integers(0, 200 * NS_PER_S), st.integers(NS_PER_S // 10, 40 * NS_PER_S))
def test_cut_keeps_the_bounds_of_pieces(red: list[int], start_ns: int, period_ns: int) -> None:
    whole = split_frames(_frames(red, []), Resets(period_ns))
    part = split_frames(_frames([time_ns for time_ns in red if time_ns >= start_ns], []), Resets(period_ns))
    assert set(part) <= set(whole)


def test_cameras_are_reset_at_different_times() -> None:
    resets = Resets(30 * NS_PER_S)
    lab = np.sort([resets.start_ns(name, 0) for name in ("red", "white", "black")])
    assert np.diff(lab).min() > 0.1 * NS_PER_S
    hall = np.array([resets.start_ns(f"camera_{number}", 0) for number in range(24)])
    # With 30 frames/s, two of 24 cameras may search the whole image in the same frame, but not more.
    in_one_frame = [
        np.count_nonzero((hall >= time_ns) & (hall < time_ns + NS_PER_S / 30)) for time_ns in hall
    ]
    assert max(in_one_frame) <= 2
    assert resets.start_ns("red", 7) - resets.start_ns("red", 3) == 4 * resets.period_ns


def _frames(red: list[int], white: list[int]) -> PieceFrames:
    rows = sorted([*((time_ns, 0) for time_ns in red), *((time_ns, 1) for time_ns in white)])
    table = np.array(rows, np.int64).reshape(-1, 2)
    return PieceFrames(("red", "white"), table[:, 0], table[:, 1])


@pytest.fixture(scope="module")
def part(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of the small session in whole seconds of log time, so that cameras have equal times."""
    path = tmp_path_factory.mktemp("pieces") / "part.mcap"
    with Session([lab_log]) as session:
        images = [session.images["red"], session.images["white"]]
        start_ns = np.sort(session.order(images)[0])[-16]
        settings = session.messages(["/rig", *session.calibrations.values()])
        messages = [*settings, *session.messages(images, int(start_ns))]
    write_log(path, (replace(m, log_time_ns=m.log_time_ns // 10**9 * 10**9) for m in messages))
    return path


def _task(session: Session, rig: Rig | None = None, **options: str) -> Task:
    task = plan_stage(writer_of(MARKERS), session, {"reset_s": "1", **options}, {}, rig)
    assert isinstance(task, Task)
    return task


def _rows(messages: Iterator[Message]) -> list[Row]:
    return [(m.topic, m.log_time_ns, m.publish_time_ns, encode(m.payload)) for m in messages]


@pytest.mark.parametrize("corners", ["edges", "stock"])
def test_pieces_in_any_order_give_the_bytes_of_one_process(corners: str, part: Path) -> None:
    with Session([part]) as session:
        # Markers that are not in the rig give events, each of them once for all pieces.
        (rig,) = session.payloads(["/rig"])
        task = _task(session, replace(rig, markers=(RigMarker(77),)), corners=corners)
        alone = _rows(compute_messages(task, session, "edges", lambda *_: None))
        plan = plan_pieces(task, session)
        assert plan is not None
        assert task.step is not None
        wired = wire(task.stage, "edges", {}, task.step("edges"))
    assert len(plan.pieces) > (4 if corners == "edges" else 1)  # stock has the usual period
    # As workers do it: pickled, each with the log opened anew, and the last piece first.
    sent = pickle.loads(pickle.dumps((plan.run, plan.pieces[::-1])))
    results = [pickle.loads(pickle.dumps(compute(sent[0], piece))) for piece in sent[1]]
    assert _rows(merge_pieces(wired, plan, results[::-1])) == alone
    assert any(topic.endswith("/events") for topic, *_ in alone)


def compute(run: PieceRun, piece: Piece) -> PieceResult:
    """Compute a piece as a worker does: with logs of its own."""
    with Session(run.paths) as session, one_blas_thread():
        return compute_piece(session, run, piece)


def _contents(result: PieceResult) -> list[tuple[int, list[bytes]]]:
    return [
        (frame.publish_time_ns, [encode(p) for p in frame.payloads if kind_of(p) in PAYLOADS.values()])
        for frame in result.frames
    ]


def test_piece_does_not_depend_on_the_frames_before_it(part: Path, tmp_path: Path) -> None:
    with Session([part]) as session:
        plan = plan_pieces(_task(session), session)
        assert plan is not None
        run, piece = plan.run, plan.pieces[-1]
        topics = ["/rig", *session.calibrations.values(), *session.images.values()]
        kept = [m for m in session.messages(topics) if m.camera is None or m.log_time_ns >= piece.start_ns]
        lenses = list(session.messages(session.calibrations.values()))
        whole = compute_piece(session, run, piece)
    write_log(tmp_path / "cut.mcap", [*lenses, *kept])
    alone = compute(replace(run, paths=(tmp_path / "cut.mcap",)), piece)
    assert whole.frames
    assert _contents(alone) == _contents(whole)


def test_error_of_a_piece_comes_at_its_frame(part: Path) -> None:
    with Session([part]) as session:
        task = _task(session)
        plan = plan_pieces(task, session)
        assert plan is not None
        topics = tuple(topic for topic in task.topics if topic != session.calibrations["white"])
        results = [compute_piece(session, replace(plan.run, topics=topics), piece) for piece in plan.pieces]
        assert task.step is not None
        wired = wire(task.stage, "edges", {}, task.step("edges"))
    assert {piece.camera for piece, result in zip(plan.pieces, results, strict=True) if result.error} == {
        "white"
    }
    messages = merge_pieces(wired, plan, results)
    with pytest.raises(IpsysError, match="camera white has no calibration"):
        list(messages)


def test_video_has_no_pieces(video_log: Path) -> None:
    with Session([video_log]) as session:
        assert order_frames(session, session.images.values()) is None


def test_order_of_frames_is_that_of_reading(lab_log: Path, part: Path) -> None:
    for paths in ([lab_log], [part]):
        with Session(paths) as session:
            topics = [*session.images.values()]
            times_ns, places = session.order(topics)
            read = [(m.log_time_ns, topics.index(m.topic)) for m in session.messages(topics)]
            assert [*zip(times_ns.tolist(), places.tolist(), strict=True)] == read


def test_latest_settings_before_a_time(part: Path) -> None:
    with Session([part]) as session:
        rig = session.latest("/rig", 0)
        assert rig is not None
        assert session.latest("/rig", rig.log_time_ns + 1) is not None
        assert session.latest("/no/topic", 0) is None
