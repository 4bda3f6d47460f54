"""Detection in a long log with worker processes, beside one process; latency of a frame after a reset.

    python benchmarks/jobs.py --job-frames 7200

``pipeline.replay`` up to detect takes turns over one log of three cameras of 960 x 540 at 30/s: with one
process, which has a thread for each camera, with two workers, and with one worker for each core. The threads
of the one process use more than one core, so the same process on one core takes turns with them. Processor
times include those of the workers. The share of the first process limits the speed with many cores: this
process merges, encodes and writes.

The limit of the machine: the pieces of the same log in one process and in two that share nothing, which have
loaded all libraries before. Two cores of a virtual machine rarely compute twice as much as one.

Latency: single frames of 1920 x 1080 in one thread, from the compressed image to the markers, in the first
frame after a reset and in all other frames.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import os
import statistics
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from results import Report, command
from rounds import Contender, Row, Turn, race, ratio_row
from scenes import CACHE, drawn, lengthened

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import MARKERS

if TYPE_CHECKING:
    from ipsys_log.engine.pieces import Piece, PieceFrames, PiecePlan

__all__ = ["measure"]

_MS_PER_S = 1e3
_ONE_CORE = "--jobs 1 on one core"
_ALONE, _APART = "pieces, one process", "pieces, two processes"


class _Turn(NamedTuple):
    """Processor times in s of the first process and of its workers, and a hash of the written log."""

    own_s: float
    workers_s: float
    digest: str


def _detection(path: Path, jobs: int, one_core: bool = False) -> Turn:
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.pipeline import replay

    target = path.with_name(f"jobs_{jobs}.mcap")
    if one_core:  # of this process, which is new in each round
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])

    def turn(_number: int) -> _Turn:
        target.unlink(missing_ok=True)
        before = os.times()
        replay([path], Request(), until="detect", output=target, jobs=jobs)
        after = os.times()
        return _Turn(
            after.user + after.system - before.user - before.system,
            after.children_user + after.children_system - before.children_user - before.children_system,
            hashlib.sha256(target.read_bytes()).hexdigest(),
        )

    return turn


def _pieces(path: Path, processes: int) -> Turn:
    """Compute the pieces of a log in processes that share nothing, and discard the results."""
    context = multiprocessing.get_context("spawn")
    lines = []
    for number in range(processes):
        line, remote = context.Pipe()
        context.Process(target=_compute_share, args=(remote, path, number, processes), daemon=True).start()
        lines.append(line)
    for line in lines:
        line.recv()

    def turn(_number: int) -> None:
        for line in lines:
            line.send(None)
        for line in lines:
            line.recv()

    return turn


def _compute_share(line: Connection, path: Path, number: int, processes: int) -> None:
    """Compute one share of the pieces of a log when the line says so."""
    import cv2

    from ipsys_log.engine.pieces import compute_piece

    cv2.setNumThreads(1)
    with Session([path]) as session:
        plan = _detection_plan(session)
        share = _share(plan.pieces, plan.frames, number, processes)
        compute_piece(session, plan.run, share[-1]._replace(end_ns=share[-1].start_ns))  # loads all libraries
        line.send(None)
        line.recv()
        for piece in share:
            compute_piece(session, plan.run, piece)
        line.send(None)


def _detection_plan(session: Session) -> PiecePlan:
    from ipsys_log.engine.graph import Task, plan_stage, writer_of
    from ipsys_log.engine.pieces import plan_pieces
    from ipsys_log.engine.request import Request

    task = plan_stage(writer_of(MARKERS), session, Request().options(None), {})
    assert isinstance(task, Task)
    plan = plan_pieces(task, session)
    assert plan is not None
    return plan


def _share(pieces: list[Piece], frames: PieceFrames, number: int, processes: int) -> list[Piece]:
    """Return the pieces of one process; all processes have about the same number of frames."""
    counts = {
        piece: int(
            (
                (frames.places == frames.cameras.index(piece.camera))
                & (frames.times_ns >= piece.start_ns)
                & (frames.times_ns < piece.end_ns)
            ).sum()
        )
        for piece in pieces
    }
    shares: list[list[Piece]] = [[] for _ in range(processes)]
    for piece in sorted(pieces, key=lambda piece: -counts[piece]):
        min(shares, key=lambda share: sum(counts[one] for one in share)).append(piece)
    return shares[number]


def _speed(path: Path, frames: int, options: argparse.Namespace, report: Report) -> None:
    cores = len(os.sched_getaffinity(0))
    counts = sorted({1, 2, cores})
    contenders = [Contender(f"--jobs {jobs}", _detection, (path, jobs)) for jobs in counts]
    contenders.append(Contender(_ONE_CORE, _detection, (path, 1, True)))
    contenders += [Contender(_ALONE, _pieces, (path, 1)), Contender(_APART, _pieces, (path, 2))]
    timings = race(contenders, 1, options.rounds)
    alone, apart = timings.pop(_ALONE), timings.pop(_APART)
    turns: dict[str, _Turn] = {name: timing.kept[0] for name, timing in timings.items()}
    if len({turn.digest for turn in turns.values()}) != 1:
        raise SystemExit("jobs: the logs differ")
    for jobs in counts[1:]:
        name = f"--jobs {jobs}"
        wanted = (">=", 1.8) if jobs == 2 else None
        report.rows.append(
            ratio_row(f"--jobs 1 / {name}", timings["--jobs 1"], timings[name], wanted, wall=True)
        )
        report.rows.append(ratio_row(f"{_ONE_CORE} / {name}", timings[_ONE_CORE], timings[name], wall=True))
        turn = turns[name]
        share = turn.own_s / (turn.own_s + turn.workers_s)
        report.rows.append(Row(f"{name}: share of the first process", (share,)))
        extra = (turn.own_s + turn.workers_s) / sum(turns["--jobs 1"][:2])
        report.rows.append(Row(f"{name} / 1, by processor", (extra,)))
    report.rows.append(ratio_row("limit: two separate processes / one", alone, apart, wall=True))
    report.rows.append(ratio_row("two separate processes / --jobs 2", apart, timings["--jobs 2"], wall=True))
    for name, timing in timings.items():
        turn = turns[name]
        busy = (turn.own_s + turn.workers_s) / timing.wall_s[0]
        report.rows.append(Row(f"{name}: cores in use", (busy,)))
        report.rows.append(Row(name, tuple(frames / s for s in timing.wall_s), "frames/s"))
        report.details[name] = {"wall_s": timing.wall_s, "first_round": turns[name]._asdict()}


def _latency(path: Path, report: Report) -> None:
    from ipsys_log.messages.channels import CALIBRATIONS, RIG
    from ipsys_log.messages.stage import Resets
    from ipsys_log.stages.detect import EDGES, Detect
    from ipsys_log.units import NS_PER_S

    resets = Resets(NS_PER_S // 2)
    times_ms: dict[bool, list[float]] = {True: [], False: []}
    with Session([path]) as session:
        for camera, topic in session.images.items():
            detect, last = Detect(EDGES, resets), -1
            for message in session.messages([*session.topics(RIG), *session.topics(CALIBRATIONS), topic]):
                begin = time.thread_time()
                list(detect(message))
                if message.topic == topic:
                    number = resets.number(camera, message.log_time_ns)
                    times_ms[number != last].append((time.thread_time() - begin) * _MS_PER_S)
                    last = number
    report.rows.append(Row("first frame after a reset", (statistics.median(times_ms[True]),), "ms"))
    report.rows.append(Row("other frames, median", (statistics.median(times_ms[False]),), "ms"))
    slow = statistics.quantiles(times_ms[False], n=100)[98]
    report.rows.append(Row("other frames, 99 %", (slow,), "ms"))
    report.details["latency_ms"] = {"after_reset": times_ms[True], "others": times_ms[False]}


def measure(options: argparse.Namespace) -> Report:
    """Measure speed, then latency."""
    report = Report("jobs")
    CACHE.mkdir(parents=True, exist_ok=True)
    drive_s = 0.5 if options.smoke else 4.0
    small = LabSettings(width=960, height=540, stations=0, drive_s=drive_s)
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        path = Path(folder) / "long.mcap"
        frames = 90 if options.smoke else options.job_frames
        lengthened(drawn(small), path, frames)
        report.remarks.append(f"{frames} frames, {path.stat().st_size / 1e9:.2f} GB")
        _speed(path, frames, options, report)
    _latency(drawn(small if options.smoke else LabSettings(stations=0, drive_s=drive_s)), report)
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--job-frames", type=int, default=7200, help="of the log, for speed")


if __name__ == "__main__":
    command("jobs")
