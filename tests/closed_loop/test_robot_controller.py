"""The example controller: it reaches its waypoints with delay and loss, and stops without positions."""

import socket
from collections import deque
from math import hypot
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.capture.simulation.robot_lab import DifferentialDrive, Pose2d
from ipsys_log.live_runs.robot_runs.settings import PATHS
from ipsys_log.units import NS_PER_S
from tests.closed_loop.example_robot import FOLDER, example

controllers: Any = example("controller")
receivers: Any = example("positions")
TICK_NS = NS_PER_S // 20
POINTS = [(place.x_m, place.y_m) for place in PATHS[0]]


def drive(
    seed: int, delay_s: float = 0.1, loss: float = 0.0, outage_s: tuple[float, float] = (0, 0)
) -> tuple[list[tuple[int, Pose2d]], list[tuple[float, str, Pose2d]]]:
    """Drive without images: positions have 5 Hz and 1 mm of noise.

    Returns
    -------
    The numbers of the waypoints that the robot left or finished at, each with the true pose there; and time,
    state and true pose at each tick.
    """
    rng = np.random.default_rng(seed)
    robot = DifferentialDrive(Pose2d(0.53, 0.48, 1.4), 0, rng)
    controller = controllers.Controller(POINTS)
    waiting: deque[tuple[int, Any]] = deque()
    pose, reached, ticks = None, [], []
    for time_ns in range(0, 120 * NS_PER_S, TICK_NS):
        robot.advance(time_ns)
        true = robot.pose_at(time_ns)
        time_s = time_ns / NS_PER_S
        is_out = outage_s[0] <= time_s < outage_s[1]
        if time_ns % (4 * TICK_NS) == 0 and rng.random() >= loss and not is_out:
            x_m, y_m = (np.array([true.x_m, true.y_m]) + 0.001 * rng.standard_normal(2)).tolist()
            waiting.append((time_ns, receivers.Pose(time_s, 0.0, x_m, y_m, true.heading_rad, time_ns)))
        while waiting and waiting[0][0] + delay_s * NS_PER_S <= time_ns:
            pose = waiting.popleft()[1]._replace(arrival_s=time_s)
        number = controller.number
        (left_m_s, right_m_s), state = controller.step(pose, time_s)
        robot.command(left_m_s, right_m_s)
        ticks.append((time_s, state, true))
        if controller.number > number or state == "finished":
            reached.append((number, true))
        if state == "finished":
            break
    return reached, ticks


@settings(max_examples=8)
@given(st.integers(0, 1000), st.sampled_from([0.05, 0.25]), st.sampled_from([0.0, 0.1]))
def test_robot_stands_within_two_centimetres(seed: int, delay_s: float, loss: float) -> None:
    reached, _ = drive(seed, delay_s, loss)
    assert [number for number, _ in reached] == [0, 1, 2, 3]
    for number, true in reached:
        x_m, y_m = POINTS[number]
        assert hypot(true.x_m - x_m, true.y_m - y_m) < 0.02


def test_robot_without_positions_stops_and_goes_on() -> None:
    reached, ticks = drive(3, outage_s=(8.0, 13.0))
    assert len(reached) == 4
    # The last position is of 7.8 s, arrives at 7.9 s, and is too old at 8.4 s; the motors have a lag.
    standing = [true for time_s, state, true in ticks if 9.0 < time_s < 13.0 and state == "stopped"]
    assert len(standing) == pytest.approx(4.0 * 20, abs=2)
    moved_m = [hypot(true.x_m - standing[0].x_m, true.y_m - standing[0].y_m) for true in standing]
    assert max(moved_m) < 0.001
    before = next(true for time_s, _, true in ticks if time_s >= 7.8)
    assert hypot(standing[0].x_m - before.x_m, standing[0].y_m - before.y_m) < 0.26 * 1.0
    assert [state for time_s, state, _ in ticks if 13.5 < time_s < 14.0] == ["driving"] * 9


def test_receiver_ignores_old_foreign_and_stale_datagrams() -> None:
    receiver = receivers.UdpPositions(("127.0.0.1", 0), "ada")
    good = (
        b'{"ipsys":1,"session":2,"seq":5,"robot":"ada","time_ns":1000,"stale":false,'
        b'"x_m":1.0,"y_m":2.0,"heading_rad":0.1}'
    )
    bad = [
        good.replace(b'"seq":5', b'"seq":5').replace(b"1.0", b"7.0"),  # repeated
        good.replace(b'"session":2,"seq":5', b'"session":1,"seq":9').replace(b"1.0", b"7.0"),
        good.replace(b"ada", b"bob").replace(b'"seq":5', b'"seq":6').replace(b"1.0", b"7.0"),
        good.replace(b"false", b"true").replace(b'"seq":5', b'"seq":7').replace(b"1.0", b"7.0"),
        good.replace(b'"ipsys":1', b'"ipsys":2').replace(b'"seq":5', b'"seq":8').replace(b"1.0", b"7.0"),
        *(b"", b"{", b"[]", b"1", b"[" * 2000, b'{"ipsys":1}', b"\xff" * 40),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (good, *bad):
            sender.sendto(datagram, receiver.socket.getsockname())
        while receiver.count < 1 + len(bad):
            receiver.receive(5.0, 3.0)
    receiver.socket.close()
    assert (receiver.pose.x_m, receiver.pose.arrival_s) == (1.0, 3.0)


def test_example_needs_only_the_standard_library() -> None:
    """Only the receiver of ROS 2 needs a package, and the program loads it late."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.py")}
    imported = {
        (name, line.split()[1].partition(".")[0])
        for name, text in texts.items()
        for line in text.splitlines()
        if line.startswith(("import ", "from "))
    }
    allowed = {
        *("argparse", "contextlib", "json", "math", "queue", "select", "socket", "struct", "time", "typing"),
        *("controller", "positions"),
    }
    assert {(name, module) for name, module in imported if module not in allowed} == {
        ("ros2_positions", "zenoh")
    }
