"""Latency of the streams: from the arrival of a frame to the client, with ten clients, some of them faulty.

    python benchmarks/streams.py --stream-seconds 20 --rounds 3

FFmpeg serves three streams of 1920 x 1080 at 30/s, as for ``live``. ``ipsys live`` runs without and with
streams, in turns. Ten clients are in a process of their own: two on UDP, two on VRPN, one each on MAVLink,
ROS 2 and Foxglove; one that never reads, one that sends garbage, and one that vanishes.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from results import Report, command
from rounds import Row
from scenes import drawn
from stream_clients import CLIENTS
from stream_costs import ROBOT, cost_rows, hand_over_rows
from stream_server import free_ports, loops_of, serve

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import FRAME_SKIPPED, Latency, Tracks
from ipsys_log.messages.channels import EVENTS, TRACKS
from ipsys_log.statistics.latency import latency_percentiles, recorded_latencies, step_times_s

__all__ = ["measure"]

_NS_PER_MS = 1e6
_LIMIT_S = 120.0
# Positions before the clients are connected, and those on their way at the end, are not counted.
_EDGE_S = 2.0
_FRESH_NS = 300_000_000
# Messages of the measurement of the hand-over.
_HANDED_OVER = 300


@dataclass(slots=True)
class _Run:
    """A run of ``ipsys live``: its ledger, the times of its positions, and the arrivals at each client.

    A position outside the calibrated volume or without heading is not counted: some streams withhold it.

    Attributes
    ----------
    poses : capture times of the positions; ``poses_of_first``: of those of the first robot.
    """

    ledger: list[Latency]
    skipped: int
    frames: int
    poses: list[int]
    poses_of_first: list[int]
    arrivals: dict[str, list[list[tuple[int, int]]]] = field(default_factory=dict)


def _go_live(folder: Path, lab: Path, calibrated: Path, seconds: float, with_streams: bool) -> _Run:
    loops, log = loops_of(lab, folder), folder / "live.mcap"
    log.unlink(missing_ok=True)
    *udp, mavlink, vrpn, ros2, foxglove = free_ports(CLIENTS["UDP"] + 4)
    options: list[str] = []
    if with_streams:
        options = [text for port in udp for text in ("--udp", f"127.0.0.1:{port}")]
        options += [
            "--mavlink",
            f"{ROBOT}=127.0.0.1:{mavlink}",
            "--vrpn-port",
            str(vrpn),
            "--ros2-port",
            str(ros2),
            "--foxglove-port",
            str(foxglove),
        ]
    with serve(lab, loops, 3, folder, _LIMIT_S) as served:
        program = subprocess.Popen(
            [
                *(sys.executable, "-m", "ipsys_log", "live", "--rig", str(served.rig)),
                *("--model-from", str(calibrated), "-o", str(log), "--seconds", str(seconds), *options),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        arrivals = _listen(program, udp, mavlink, vrpn, ros2) if with_streams else {}
        _, said = program.communicate()
        if program.returncode:
            raise SystemExit(f"ipsys live ended with {program.returncode}: {said.strip()[-200:]}")
    return _read(log, arrivals)


def _listen(
    program: subprocess.Popen[str], udp: list[int], mavlink: int, vrpn: int, ros2: int
) -> dict[str, list[list[tuple[int, int]]]]:
    """Run the clients as long as the program; return the arrivals at each client."""
    assert program.stderr is not None
    for line in program.stderr:
        if line.startswith("Foxglove"):
            address = line.split()[-1]
            break
    else:
        raise SystemExit("ipsys live printed no address for Foxglove")
    arguments = [",".join(map(str, udp)), str(mavlink), str(vrpn), str(ros2), address]
    script = str(Path(__file__).with_name("stream_clients.py"))
    with subprocess.Popen(
        [sys.executable, script, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as clients:
        program.stderr.read()
        program.wait()
        text, _ = clients.communicate("", timeout=_LIMIT_S)
    found: dict[str, list[list[tuple[int, int]]]] = json.loads(text)
    return found


def _read(log: Path, arrivals: dict[str, list[list[tuple[int, int]]]]) -> _Run:
    with Session([log]) as session:
        events = session.payloads(session.topics(EVENTS))
        frames = sum(session.count(topic) for topic in session.images.values())
        tracks: list[Tracks] = session.payloads(session.topics(TRACKS))
    good = [
        (row.timestamp, track.robot)
        for row in tracks
        for track in row.tracks
        if track.inside is not False and track.heading_rad is not None
    ]
    poses, of_first = [t for t, _ in good], [t for t, robot in good if robot == ROBOT]
    skipped = sum(event.kind == FRAME_SKIPPED for event in events)
    return _Run(recorded_latencies([log]), skipped, frames, poses, of_first, arrivals)


def _after_ms(run: _Run, client: list[tuple[int, int]]) -> NDArray[np.float64]:
    """Return for each position the time from its publishing to the client, in ms."""
    # VRPN has times in us.
    published = {entry.timestamp // 1000: entry.published for entry in run.ledger}
    late = [arrived - published[t // 1000] for t, arrived in client if t // 1000 in published]
    return np.array(late, dtype=np.float64) / _NS_PER_MS


def _lost(run: _Run, poses: list[int], client: list[tuple[int, int]]) -> int:
    """Return how many poses a client missed, without the edges of the run and old positions.

    Most streams withhold positions that are older than 0.5 s: those of a machine that is too slow.
    """
    edge_ns = round(_EDGE_S * 1e9)
    first_ns = client[0][0] + edge_ns if client else 0
    last_ns = max(poses, default=0) - edge_ns
    fresh = {e.timestamp // 1000 for e in run.ledger if e.published - e.timestamp < _FRESH_NS}
    expected = {t // 1000 for t in poses if first_ns <= t <= last_ns} & fresh
    return len(expected - {t // 1000 for t, _ in client})


def _rows(pairs: list[tuple[_Run, _Run]], report: Report) -> None:
    if not all(run.ledger for pair in pairs for run in pair):
        report.remarks.append("a run has no positions: the machine is too slow, or busy")
        report.failed = True
        return
    totals = [[1e3 * step_times_s(run.ledger)["total"] for run in pair] for pair in pairs]
    for title, share, most in (("median", 50, 2), ("99 %", 99, 10)):
        extra = tuple(float(np.percentile(b, share) - np.percentile(a, share)) for a, b in totals)
        report.rows.append(Row(f"later by streams: position, {title}", extra, "ms", ("<=", most)))
    for stream, count in CLIENTS.items():
        after = [[_after_ms(run, client) for client in run.arrivals[stream]] for _, run in pairs]
        joined = [np.concatenate(clients) for clients in after]
        if all(len(rows) for rows in joined):
            for title, share, most in (("median", 50, 2), ("99 %", 99, 10)):
                values = tuple(float(np.percentile(rows, share)) for rows in joined)
                report.rows.append(Row(f"position to {stream}, {title}", values, "ms", ("<=", most)))
        lost = []
        for _, run in pairs:
            poses = run.poses_of_first if stream == "MAVLink" else run.poses
            lost.append(sum(_lost(run, poses, client) for client in run.arrivals[stream]))
        name = f"lost by {stream} clients ({count})"
        report.rows.append(Row(name, tuple(map(float, lost)), "positions", ("<=", 0)))
    for name, index in (("without", 0), ("with", 1)):
        runs = [pair[index] for pair in pairs]
        skipped = tuple(float(run.skipped) for run in runs)
        report.rows.append(Row(f"skipped {name} streams", skipped, "frames"))
        report.rows.append(
            Row(f"recorded {name} streams", tuple(float(run.frames) for run in runs), "frames")
        )


def _table(pairs: list[tuple[_Run, _Run]]) -> str:
    """Return the table of medians and 99 % in ms: capture, received, position, client."""
    lines = [f"{'median / 99 %, ms':<12}{'to received':>15}{'to position':>15}{'to client':>15}{'whole':>15}"]
    for stream in CLIENTS:
        cells: list[list[NDArray[np.float64]]] = [[], [], [], []]
        for _, run in pairs:
            steps = step_times_s(run.ledger)
            by_time = {entry.timestamp // 1000: entry for entry in run.ledger}
            rows = [
                (by_time[t // 1000], a) for c in run.arrivals[stream] for t, a in c if t // 1000 in by_time
            ]
            cells[0].append(1e3 * steps["received"])
            cells[1].append(1e3 * steps["total"])
            cells[2].append(np.array([(a - entry.published) / _NS_PER_MS for entry, a in rows]))
            cells[3].append(np.array([(a - entry.received) / _NS_PER_MS for entry, a in rows]))
        lines.append(f"{stream:<12}" + "".join(_cell(np.concatenate(cell)) for cell in cells))
    return "\n".join([*lines, "whole: from the arrival of the frame to the client"])


def _cell(values: NDArray[np.float64]) -> str:
    if not len(values):
        return f"{'-':>15}"
    return f"{f'{np.percentile(values, 50):.1f} / {np.percentile(values, 99):.1f}':>15}"


def measure(options: argparse.Namespace) -> Report:
    """Measure the latency of streams, in runs with and without streams that alternate."""
    report = Report("streams")
    if shutil.which("ffmpeg") is None:
        report.remarks.append("no ffmpeg to serve the streams; on Debian: sudo apt-get install ffmpeg")
        return report
    settings = LabSettings(stations=25, frames_per_station=2, drive_s=2.0, jpeg_quality=92)
    lab = drawn(replace(settings, width=640, height=360, stations=25) if options.smoke else settings)
    seconds = 8.0 if options.smoke else options.stream_seconds
    pairs = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        calibrated = folder / "calibration.mcap"
        pipeline.replay([lab], Request(), output=calibrated)
        for _ in range(options.rounds):
            without = _go_live(folder, lab, calibrated, seconds, with_streams=False)
            pairs.append((without, _go_live(folder, lab, calibrated, seconds, with_streams=True)))
    report.rows += cost_rows(options.rounds)
    report.rows += hand_over_rows(options.rounds, 10 if options.smoke else _HANDED_OVER)
    _rows(pairs, report)
    report.tables.append(_table(pairs))
    report.details["latency_ms"] = {
        name: [1e3 * p.median_s, 1e3 * p.p99_s]
        for name, p in latency_percentiles(step_times_s(pairs[-1][1].ledger)).items()
    }
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--stream-seconds", type=float, default=20.0, help="of a run with three streams")


if __name__ == "__main__":
    command("streams")
