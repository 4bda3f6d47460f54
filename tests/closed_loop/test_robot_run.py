"""Robot runs in simulated time: waypoints, lost datagrams, a failing camera, and equal bytes."""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.request import Request
from ipsys_log.exchange.data_frames import read_table
from ipsys_log.live_runs.robot_runs.run import ROBOT_RUN, drive_robots
from ipsys_log.live_runs.robot_runs.settings import PROGRAM, CameraFailure, RobotRun, choose_paths, read_lab
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Event, RobotPath, WheelCommand
from ipsys_log.messages.channels import COMMANDS, EVENTS, IMAGES, PATHS, TRACKS, TRUTH
from ipsys_log.tools.robot_run import RobotRunResult, read_robot_run
from tests.conftest import Ipsys
from tests.shared_files import make_once

pytestmark = pytest.mark.slow

SHORT = "robot_0=2,2.2 2.3,2.2"


def settings_of(replayed_log: Path, *paths: str, robots: int = 1, rate_hz: float = 4.0) -> RobotRun:
    lab = read_lab(replayed_log, LabSettings(markers=robots, rate_hz=rate_hz))
    return RobotRun(
        lab, choose_paths(robots, paths), PROGRAM, lockstep=True, port=0, tick_hz=10.0, longest_s=120
    )


@pytest.fixture(scope="module")
def faulty_log(replayed_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The path of the paper, with 5 % lost datagrams, 100 ms of delay, and a camera that fails for 5 s."""
    run = replace(
        settings_of(replayed_log), loss=0.05, delay_s=0.1, failures=(CameraFailure("white", 22.0, 5.0),)
    )

    def write(folder: Path) -> None:
        drive_robots(run, folder / "run.mcap", Request(models=("poly",), model_from=replayed_log))

    return make_once(tmp_path_factory, "robot_run", write) / "run.mcap"


def result_of(log: Path) -> RobotRunResult:
    with Session([log]) as session:
        return read_robot_run(session)


def test_robot_stands_at_its_waypoints(faulty_log: Path) -> None:
    (robot,) = result_of(faulty_log).robots
    assert robot.is_finished
    assert [point.number for point in robot.reached] == [1, 2, 3, 4]
    for point in robot.reached:
        assert point.control_m < 0.02
        # The true error is at most the sum of both errors; the sums of noise and rounding are below 1 mm.
        assert point.true_m is not None
        assert point.true_m.max_m <= point.control_m + point.positioning_m["poly"].max_m + 0.001
        assert point.positioning_m["poly"].max_m < 0.05


def test_robot_without_camera_stops_and_goes_on(faulty_log: Path) -> None:
    (robot,) = result_of(faulty_log).robots
    (stop,) = robot.stops
    assert stop.age_s is not None
    # 0.5 s without a position, at most one frame, the delay, and a tick; one datagram may be lost.
    assert 0.5 < stop.age_s < 0.5 + 2 * 0.25 + 0.1 + 0.2
    assert stop.braking_m is not None
    assert stop.braking_m < 0.26 * (stop.age_s + 0.5)
    assert stop.moved_m is not None
    assert stop.moved_m < 0.002
    with Session([faulty_log]) as session:
        events: list[Event] = session.payloads(session.topics(EVENTS))
    kinds = [(event.kind, event.camera) for event in events]
    assert [kind for kind in kinds if kind[1]] == [("camera_lost", "white"), ("camera_back", "white")]
    (described,) = [event.text for event in events if event.kind == ROBOT_RUN]
    assert "5 % of the datagrams lost, 100 ms of delay, camera white fails at 22 s for 5 s" in described


def test_log_has_everything(faulty_log: Path) -> None:
    with Session([faulty_log]) as session:
        (path,) = session.payloads(session.topics(PATHS))
        commands: list[WheelCommand] = session.payloads(session.topics(COMMANDS))
        frames = {topic: session.count(topic) for topic in session.topics(IMAGES)}
        instants = [message.publish_time_ns for message in session.messages(session.topics(TRUTH))]
        tracks = [message.publish_time_ns for message in session.messages(session.topics(TRACKS, "poly"))]
    assert isinstance(path, RobotPath)
    assert [(place.x_m, place.y_m) for place in path.waypoints] == [
        (0.5, 0.5),
        (0.5, 2.5),
        (2.5, 2.5),
        (4.5, 4.5),
    ]
    assert set(np.diff([command.timestamp for command in commands]).tolist()) == {100_000_000}
    red, white = frames["/cameras/red/image"], frames["/cameras/white/image"]
    assert (red, red - white) == (len(instants), 20)  # 5 s at 4 Hz
    # Some positions are lost; the robot uses only positions that were sent.
    used = {command.position_time for command in commands if command.position_time is not None}
    assert used < set(tracks)
    assert 0.85 * len(set(tracks)) < len(used)


def test_commands_are_a_table(faulty_log: Path) -> None:
    with Session([faulty_log]) as session:
        table = read_table(session, "commands", [None], None, None)
        commands: list[WheelCommand] = session.payloads(session.topics(COMMANDS))
    assert table["left_m_s"].tolist() == [command.left_m_s for command in commands]
    assert set(table["state"]) == {"driving", "holding", "stopped", "finished"}


def test_replay_gives_the_same_bytes(faulty_log: Path, ipsys: Ipsys) -> None:
    done = ipsys("verify", faulty_log)
    assert (done.code, done.out.splitlines()[-1]) == (0, "the replay is identical to the log")


def test_report_draws_the_drive(faulty_log: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    done = ipsys("report", faulty_log, "--html", tmp_path / "run.html")
    assert (done.code, done.err) == (0, "")
    page = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert "robot_0: 4 of 4 waypoints" in page
    assert 'P4 <span class="soft">(4.5, 4.5)<' in page
    assert page.count("data:image/") == 2
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def short_run(replayed_log: Path, tmp_path: Path) -> Callable[[RobotRun, str], Path]:
    def drive(run: RobotRun, name: str) -> Path:
        drive_robots(run, tmp_path / name, Request(models=("poly",), model_from=replayed_log))
        return tmp_path / name

    return drive


def test_equal_seeds_give_equal_bytes(replayed_log: Path, short_run: Callable[[RobotRun, str], Path]) -> None:
    run = replace(settings_of(replayed_log, SHORT), loss=0.1)
    first, second = short_run(run, "first.mcap"), short_run(run, "second.mcap")
    assert first.read_bytes() == second.read_bytes()


def test_robot_drives_with_positions_of_vrpn(
    replayed_log: Path, short_run: Callable[[RobotRun, str], Path]
) -> None:
    log = short_run(replace(settings_of(replayed_log, SHORT), over="vrpn"), "vrpn.mcap")
    (robot,) = result_of(log).robots
    assert robot.is_finished
    assert max(point.control_m for point in robot.reached) < 0.02


def test_robot_drives_with_delayed_poses_of_ros_2(
    replayed_log: Path, short_run: Callable[[RobotRun, str], Path]
) -> None:
    pytest.importorskip("zenoh")
    run = replace(settings_of(replayed_log, SHORT), over="ros2", loss=0.1, delay_s=0.1)
    log = short_run(run, "ros2.mcap")
    (robot,) = result_of(log).robots
    assert robot.is_finished
    assert max(point.control_m for point in robot.reached) < 0.02
    with Session([log]) as session:
        used = {command.position_time for command in session.payloads(session.topics(COMMANDS))} - {None}
        sent = {message.publish_time_ns for message in session.messages(session.topics(TRACKS, "poly"))}
    assert used < sent


def test_three_robots_keep_their_distance(
    replayed_log: Path, short_run: Callable[[RobotRun, str], Path], ipsys: Ipsys, tmp_path: Path
) -> None:
    log = short_run(settings_of(replayed_log, robots=3), "three.mcap")
    result = result_of(log)
    assert [(robot.is_finished, len(robot.reached)) for robot in result.robots] == [(True, 4)] * 3
    assert max(point.control_m for robot in result.robots for point in robot.reached) < 0.02
    assert result.nearest_m is not None
    assert result.nearest_m > 0.45  # diagonals of two markers with margins: 0.42 m
    assert _crossings(result) >= 2
    assert ipsys("report", log, "--html", tmp_path / "three.html").code == 0
    page = (tmp_path / "three.html").read_text(encoding="utf-8")
    assert f"Smallest distance between two robots: {result.nearest_m:.2f} m" in page
    assert page.count("data:image/") == 2 * 3 + 1  # panels and map of each, and a map of all


def _crossings(result: RobotRunResult) -> int:
    """Return the number of pairs of robots whose true paths come within 5 cm of each other, at any times."""
    paths_m = [robot.true.points_m[:, None, :2] for robot in result.robots if robot.true is not None]
    return sum(
        np.linalg.norm(one - other.transpose(1, 0, 2), axis=2).min() < 0.05
        for one, other in combinations(paths_m, 2)
    )


def test_real_time_run_records_frames_and_commands(
    replayed_log: Path, short_run: Callable[[RobotRun, str], Path]
) -> None:
    """A busy machine may not reach a waypoint; the log is complete anyway."""
    run = replace(settings_of(replayed_log, SHORT, rate_hz=2.0), lockstep=False, longest_s=4.0)
    with Session([short_run(run, "live.mcap")]) as session:
        counts = {name: sum(map(session.count, session.topics(name))) for name in (IMAGES, TRUTH, COMMANDS)}
        times_ns = [message.publish_time_ns for message in session.messages(session.topics(TRUTH))]
        frames_ns = {message.publish_time_ns for message in session.messages(session.topics(IMAGES))}
    assert min(counts.values()) > 0
    assert len(times_ns) == len(set(times_ns))
    # The frames of the first instants may come before the start.
    assert len(frames_ns - set(times_ns)) <= 6
