"""A hall at its centre: markers of many nodes, over sessions of Zenoh on loopback.

    python benchmarks/hall_nodes.py --hall-seconds 45 --hall-cameras 4x3

The markers of twelve robots come from exact geometry, with the noise of ``detect``. No image is rendered.
Nodes play them in real time, several in one process; ``ipsys live`` runs as for a user, in a process of its
own. The nodes have the lowest priority, because those of a hall run on other machines. The first seconds are
not counted. The latency is the time from the arrival of the markers at the centre, in the thread of Zenoh, to
the published position. The processor time is that of the centre and its receiving process. All programs share
the cores of this machine, so another program increases the latency. The steps are processor times of a
message, in one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from results import Report, command
from rounds import Row
from stream_server import free_ports, write_lens

from ipsys_log.capture.camera_thread import NODES_RUN
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.live_check import KnockMonitor
from ipsys_log.capture.live_plan import plan_live
from ipsys_log.capture.nodes.wire import MARKERS_FORMAT
from ipsys_log.capture.simulation.settings import hall_settings, parse_grid
from ipsys_log.engine.output import write_log, write_message
from ipsys_log.engine.request import Request
from ipsys_log.engine.stream import run
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import FRAME_SKIPPED, Latency, RigNodes, Tracks
from ipsys_log.messages.channels import EVENTS, MARKERS, TRACKS
from ipsys_log.messages.rig_file import rig_toml
from ipsys_log.statistics.disagreement import OverlapSummary
from ipsys_log.statistics.latency import recorded_latencies, step_times_s
from ipsys_log.units import NS_PER_S
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import MARKERS_RUN, simulate_session

__all__ = ["measure"]

_ROBOTS = 12
# Taped points for each camera: the models of the table need their own.
_POINTS = 10
_PER_PROCESS = 6
# The time between the start signal and the first frame, and the time before the measurement begins.
_AHEAD_S, _WARM_S = 1.0, 5.0
# The last part of a run, with rows of its own.
_LAST_S = 10.0
_MS = 1000.0


@dataclass(frozen=True, slots=True)
class _Hall:
    """The files of a hall: the log with the model, the log with the markers, and the cameras."""

    calibrated: Path
    played: Path
    cameras: list[str]


@dataclass(frozen=True, slots=True)
class _Usage:
    """Processor time in s, and largest memory in MB, of a process and its children so far.

    ``time_s`` is the time of day.
    """

    time_s: float
    cpu_s: float
    memory_mb: float

    @classmethod
    def of(cls, pid: int) -> _Usage:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        status = Path(f"/proc/{pid}/status").read_text().splitlines()
        peak_kb = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
        ticks = int(fields[11]) + int(fields[12])
        children = [
            cls.of(int(child))
            for task in Path(f"/proc/{pid}/task").iterdir()
            for child in (task / "children").read_text().split()
        ]
        return cls(
            time.time(),
            ticks / os.sysconf("SC_CLK_TCK") + sum(child.cpu_s for child in children),
            peak_kb / 1000 + sum(child.memory_mb for child in children),
        )


def make_hall(
    folder: Path, grid: str, seconds: float, model: str, in_step: bool, rate_hz: float = 30.0
) -> _Hall:
    """Simulate a hall: its calibration, and the markers of a drive of the robots."""
    size = parse_grid(grid)
    still = hall_settings(*size, markers=_ROBOTS, rate_hz=rate_hz, drive_s=0.0)
    count = len(still.cameras)
    calibrated, played = folder / "calibration.mcap", folder / "markers.mcap"
    points = GeometricSettings(lab=still, points=_POINTS * count)
    write_log(calibrated, simulate_session(build_lab(points)))
    pipeline.replay([calibrated], Request(models=(model,)), "fit")
    delays_s = (0.0,) if in_step else tuple(n / count / rate_hz for n in range(count))
    drive = GeometricSettings(lab=replace(still, drive_s=seconds), points=0, frame_delays_s=delays_s)
    write_log(played, simulate_session(build_lab(drive)))
    return _Hall(calibrated, played, list(still.cameras))


def write_rig(hall: _Hall, folder: Path, port: int) -> Path:
    """Write the rig file of the centre: all cameras are those of nodes."""
    with Session([hall.calibrated]) as session:
        (rig,) = session.payloads(["/rig"])
        lenses = {name: session.payloads([topic])[0] for name, topic in session.calibrations.items()}
    cameras = tuple(
        replace(
            camera,
            source=f"zenoh:{camera.name}",
            calibration=write_lens(folder / f"{camera.name}.yaml", lenses[camera.name]),
        )
        for camera in rig.cameras
    )
    path = folder / "lab.toml"
    path.write_text(rig_toml(replace(rig, cameras=cameras, nodes=RigNodes(f"127.0.0.1:{port}"))))
    return path


@dataclass(frozen=True, slots=True)
class _Run:
    """A run of the centre: its ledger, usage between two instants, and the numbers of messages.

    ``sent`` are messages of markers. ``lost`` are those after the beginning that the log does not have,
    ``left`` those that the nodes still have at the end.
    """

    latencies: list[Latency]
    begin: _Usage
    end: _Usage
    sent: int
    lost: int
    left: int
    events: dict[str, int]
    robots: set[str]

    def last(self, seconds: float) -> list[Latency]:
        """Return the latencies of the markers that arrived in the last part of the measurement."""
        return [e for e in self.latencies if e.received >= (self.end.time_s - seconds) * NS_PER_S]


def run_centre(
    hall: _Hall,
    folder: Path,
    model: str,
    options: Sequence[str] = (),
    program: Sequence[str] = ("-m", "ipsys_log"),
) -> _Run:
    """Run ``ipsys live`` with nodes that play the markers of a hall.

    Parameters
    ----------
    options : further options of the command.
    program : the arguments of Python before those of the command.
    """
    port, log = free_ports(1)[0], folder / "live.mcap"
    log.unlink(missing_ok=True)
    rig = write_rig(hall, folder, port)
    centre = ["live", "--rig", rig, "--model-from", hall.calibrated, "--model", model, "-o", log, *options]
    groups = [hall.cameras[n : n + _PER_PROCESS] for n in range(0, len(hall.cameras), _PER_PROCESS)]
    with ExitStack() as stack:
        said = stack.enter_context(tempfile.TemporaryFile("w+"))
        live = stack.enter_context(_program([*program, *centre], stdout=subprocess.DEVNULL, stderr=said))
        script = str(Path(__file__).with_name("node_players.py"))
        players = [
            stack.enter_context(
                _program(
                    [script, hall.played, f"127.0.0.1:{port}", ",".join(group)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                )
            )
            for group in groups
        ]
        Thread(target=_end_with, args=(live, players), daemon=True).start()
        try:
            begin, end, reports = _follow(live, players)
        finally:
            if live.wait():
                said.seek(0)
                raise SystemExit(f"ipsys live ended with {live.returncode}: {said.read().strip()[-300:]}")
    return _read(log, model, begin, end, reports)


@contextmanager
def _program(arguments: Iterable[object], **streams: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a program of Python; end it with the block."""
    with subprocess.Popen([sys.executable, *map(str, arguments)], text=True, **streams) as program:
        try:
            yield program
        finally:
            program.kill()


def _end_with(live: subprocess.Popen[str], players: Sequence[subprocess.Popen[str]]) -> None:
    """End the nodes of a centre that has failed."""
    if live.wait():
        for player in players:
            player.kill()


def _follow(
    live: subprocess.Popen[str], players: Sequence[subprocess.Popen[str]]
) -> tuple[_Usage, _Usage, list[dict[str, Any]]]:
    """Start all players at one time; return the usage of the centre after the warm-up and at the end."""
    for player in players:
        _read_line(player, "asked")
    start_ns = time.time_ns() + round(_AHEAD_S * NS_PER_S)
    for player in players:
        assert player.stdin is not None
        player.stdin.write(f"{start_ns}\n")
        player.stdin.flush()
    time.sleep(_AHEAD_S + _WARM_S)
    begin = _Usage.of(live.pid)
    for player in players:
        _read_line(player, "played")
    end = _Usage.of(live.pid)
    return begin, end, [json.loads(player.communicate()[0]) for player in players]


def _read_line(player: subprocess.Popen[str], expected: str) -> None:
    assert player.stdout is not None
    line = player.stdout.readline().strip()
    if line != expected:
        raise SystemExit(f"the nodes ended before they were {expected}")


def _read(log: Path, model: str, begin: _Usage, end: _Usage, reports: list[dict[str, Any]]) -> _Run:
    with Session([log]) as session:
        kinds = [event.kind for event in session.payloads(session.topics(EVENTS))]
        numbers: dict[str, list[int]] = defaultdict(list)
        for message in session.messages(session.topics(MARKERS, NODES_RUN)):
            numbers[str(message.camera)].append(message.payload.node_frame)
        tracks: list[Tracks] = session.payloads(session.topics(TRACKS, model))
    return _Run(
        [entry for entry in recorded_latencies([log]) if entry.received >= begin.time_s * NS_PER_S],
        begin,
        end,
        sum(sum(report["sent"].values()) for report in reports),
        sum(_lost(numbers[camera], count) for report in reports for camera, count in report["sent"].items()),
        sum(report["left"] for report in reports),
        {kind: kinds.count(kind) for kind in sorted(set(kinds))},
        {track.robot for row in tracks for track in row.tracks},
    )


def _lost(numbers: Sequence[int], sent: int) -> int:
    """Return the frames of a node that are not in the log, after the first one of the log.

    The centre discards frames while it prepares the stages.
    """
    recorded = set(numbers)
    return sent - min(recorded) - len(recorded) if recorded else sent


def _most_waiting(entries: Iterable[Latency]) -> int:
    """Return the largest number of messages that have arrived and have no position yet."""
    changes = sorted(
        (time_ns, step) for e in entries for time_ns, step in ((e.received, 1), (e.published, -1))
    )
    return int(np.cumsum([step for _, step in changes]).max()) if changes else 0


def _rows(title: str, runs: Sequence[_Run]) -> Iterator[Row]:
    cores = [(run.end.cpu_s - run.begin.cpu_s) / (run.end.time_s - run.begin.time_s) for run in runs]
    yield Row(f"{title}: centre, cores", tuple(cores), "cores", ("<=", 1.0))
    limits: tuple[tuple[str, int, tuple[str, float] | None], ...]
    limits = (("median", 50, None), ("99 %", 99, ("<=", 50.0)))
    for part, seconds in (("position", math.inf), ("at the end", _LAST_S)):
        totals_ms = [_MS * step_times_s(run.last(seconds))["total"] for run in runs]
        for name, share, wanted in limits:
            values = tuple(float(np.percentile(total, share)) for total in totals_ms)
            yield Row(f"{title}: {part}, {name}", values, "ms", wanted)
    skipped = [run.events.get(FRAME_SKIPPED, 0) for run in runs]
    counts: Mapping[str, tuple[str, Sequence[float], tuple[str, float] | None]] = {
        "not recorded": ("messages", [run.lost for run in runs], ("<=", 0.0)),
        "most waiting": ("messages", [_most_waiting(run.latencies) for run in runs], None),
        "skipped": ("messages", skipped, ("<=", 0.0)),
        "tracked": ("robots", [len(run.robots) for run in runs], (">=", float(_ROBOTS))),
    }
    for name, (unit, numbers, wanted) in counts.items():
        yield Row(f"{title}: {name}", tuple(map(float, numbers)), unit, wanted)
    yield Row(f"{title}: memory", tuple(run.end.memory_mb for run in runs), "MB")


def step_rows(hall: _Hall, folder: Path, model: str) -> Iterator[Row]:
    """Yield the processor time of a message in each stage, in the writer, and in the overlap of cameras.

    The first messages are not counted: they contain the preparation of the stages.
    """
    with Session([hall.calibrated]) as session:
        settings = list(session.messages(["/rig", *session.calibrations.values()]))
    with Session([hall.played]) as session:
        topics = {MARKERS.topic_of(MARKERS_RUN, camera): camera for camera in hall.cameras}
        markers = [
            replace(message, topic=MARKERS.topic_of(NODES_RUN, topics[message.topic]))
            for message in session.messages(list(topics))
        ]
    states = {camera: CameraState(format=MARKERS_FORMAT) for camera in hall.cameras}
    plan = plan_live(states, settings, Request(models=(model,), model_from=hall.calibrated), None)
    messages = markers
    for wired in plan.stages:
        begin_s = time.process_time()
        list(run(settings, [wired]))
        yield Row(f"preparation of {wired.stage.name}", (time.process_time() - begin_s,), "s")
        begin_s = time.process_time()
        messages = list(run(messages, [wired]))
        yield _cost(wired.stage.name, begin_s, len(markers))
    begin_s, counts = time.process_time(), dict[str, int]()
    with LogWriter.create(folder / "written.mcap") as writer:
        for message in (*settings, *messages):
            write_message(writer, message, counts)
    yield _cost("write", begin_s, len(markers))
    consumers: dict[str, Any] = {
        "overlap of cameras": OverlapSummary(),
        "knocks": KnockMonitor(settings[0].payload),
    }
    for name, consumer in consumers.items():
        begin_s = time.process_time()
        for message in messages:
            list(consumer(message) or ())
        yield _cost(name, begin_s, len(markers))


def _cost(name: str, begin_s: float, count: int) -> Row:
    return Row(f"{name}, of a message", (_MS * (time.process_time() - begin_s) / count,), "ms")


def measure(options: argparse.Namespace) -> Report:
    """Measure the centre of a hall, with cameras that take turns and with cameras in step."""
    report = Report("hall_nodes")
    if find_spec("zenoh") is None:
        report.remarks.append("no Zenoh for the nodes: pip install 'ipsys_log[nodes]'")
        return report
    grid, seconds = ("2x1", 7.0) if options.smoke else (options.hall_cameras, options.hall_seconds + _WARM_S)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for title, in_step in (("in turns", False), ("in step", True)):
            hall = make_hall(folder, grid, seconds, options.hall_model, in_step, options.hall_rate)
            if not in_step:
                report.rows += step_rows(hall, folder, options.hall_model)
            runs = [run_centre(hall, folder, options.hall_model) for _ in range(options.rounds)]
            report.rows += _rows(title, runs)
            report.details[title] = [
                {"events": run.events, "sent": run.sent, "left": run.left, "positions": len(run.latencies)}
                for run in runs
            ]
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--hall-cameras", default="6x4", help="columns x rows of the hall")
    parser.add_argument("--hall-rate", type=float, default=30.0, help="messages of a camera per second")
    parser.add_argument("--hall-seconds", type=float, default=45.0, help="of a run, after its first 5 s")
    parser.add_argument("--hall-model", default="rayplane", help="the model of the positions")


if __name__ == "__main__":
    command("hall_nodes")
