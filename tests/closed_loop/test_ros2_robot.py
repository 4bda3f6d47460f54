"""The example robot with ROS 2: its decoder, and the relay that loses and delays its poses."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from math import remainder, tau
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.robot_runs.ros2_relay import open_ros2
from ipsys_log.sinks.streams import StreamSettings
from ipsys_log.sinks.streams.poses import StreamContext
from ipsys_log.sinks.streams.ros2 import Ros2Stream
from ipsys_log.units import NS_PER_S
from tests.closed_loop.example_robot import example
from tests.ports import free_port
from tests.sinks.streaming import START_NS, STEP_NS, TOPIC, send_all, track, tracks
from tests.waiting import wait_until

receivers: Any = example("ros2_positions")
STORE = get_typestore(Stores.LATEST)
_LIMIT_S = 60.0


def decoder() -> Any:
    """Return a receiver without a connection."""
    receiver = receivers.Ros2Positions.__new__(receivers.Ros2Positions)
    receiver.pose, receiver.count = None, 0
    return receiver


@given(
    st.integers(0, 2**31 - 1),
    st.integers(0, NS_PER_S - 1),
    st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=20),
    st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-3.14, 3.14)),
)
def test_decoder_agrees_with_rosbags(
    seconds: int, nanoseconds: int, frame: str, pose: tuple[float, float, float]
) -> None:
    types = STORE.types
    x_m, y_m, heading_rad = pose
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, nanoseconds), frame)
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(heading_rad / 2), np.cos(heading_rad / 2))
    where = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x_m, y_m, 0.5), turn)
    covered = types["geometry_msgs/msg/PoseWithCovariance"](where, np.arange(36.0))
    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    data = bytes(STORE.serialize_cdr(types[name](header, covered), name))
    receiver = decoder()
    receiver.read(data, 5.0)
    received = receiver.pose
    assert (received.time_ns, received.arrival_s) == (seconds * NS_PER_S + nanoseconds, 5.0)
    assert (received.x_m, received.y_m) == (x_m, y_m)
    assert abs(remainder(received.heading_rad - heading_rad, tau)) < 1e-9


@given(st.binary(max_size=120))
def test_decoder_ignores_other_bytes(data: bytes) -> None:
    receiver = decoder()
    receiver.read(data, 0.0)
    assert receiver.pose is None or data[:4] == receivers.LITTLE_ENDIAN


@contextmanager
def publishing() -> Iterator[Ros2Stream]:
    now_ns = lambda: START_NS  # noqa: E731
    robots = {"ada": None, "bob": None}
    context = StreamContext(StreamSettings(), {TOPIC}, now_ns, lambda kind, text: None, 1, robots)
    with closing(Ros2Stream(free_port(), context)) as stream:
        yield stream


def test_relay_passes_only_what_it_is_told_to() -> None:
    """The first pose is lost between stream and robot; the others arrive unchanged, of one robot only."""
    arrived: list[bytes] = []
    port = free_port()
    with (
        publishing() as stream,
        open_ros2("ada", stream.port, port, arrived.append) as send,
        closing(receivers.Ros2Positions(("127.0.0.1", port), "ada")) as robot,
    ):
        send_all(stream, [tracks(n, track("ada", 1.0 + n), track("bob", 9.0)) for n in range(3)])
        wait_until(lambda: len(arrived) == 3, "three poses arrive", lambda: len(arrived))
        for data in arrived[1:]:
            send(data)
        while robot.count < 2:
            robot.receive(_LIMIT_S, 7.0)
        robot.receive(0.0, 8.0)
    assert robot.count == 2
    assert (robot.pose.x_m, robot.pose.y_m) == (3.0, 2.0)
    assert (robot.pose.time_ns, robot.pose.arrival_s) == (START_NS + 2 * STEP_NS, 7.0)


def test_robot_that_is_not_published_is_named() -> None:
    with publishing() as stream:
        with pytest.raises(SystemExit, match="no node publishes /eve/pose"):
            receivers.Ros2Positions(("127.0.0.1", stream.port), "eve")
        with (
            pytest.raises(IpsysError, match="nobody publishes /eve/pose"),
            open_ros2("eve", stream.port, free_port(), lambda data: None),
        ):
            pass
