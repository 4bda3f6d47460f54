"""ROS 2 stream: a Zenoh session gets the messages of rmw_zenoh; nothing passes in or through."""

import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from itertools import count
from math import pi
from typing import Any

import numpy as np
import pytest
import zenoh
from scipy.spatial.transform import Rotation

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message
from ipsys_log.sinks.streams import StreamSettings
from ipsys_log.sinks.streams.poses import NewSession, StreamContext
from ipsys_log.sinks.streams.rmw_zenoh import Entity, Qos, attachment, gid, topic_key
from ipsys_log.sinks.streams.ros2 import Ros2Stream
from ipsys_log.sinks.streams.ros2_messages import type_hash
from ipsys_log.units import NS_PER_S
from tests.ports import free_port
from tests.sinks.open_sockets import exposed
from tests.sinks.streaming import (
    START_NS,
    STEP_NS,
    TILT_RAD,
    TOPIC,
    judged,
    moving_track,
    send_all,
    tilted_track,
    track,
    tracks,
)
from tests.sinks.zenoh_listener import ZenohListener, open_node
from tests.waiting import wait_until

STRING = "std_msgs/msg/String"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
# Printed by `ros2 topic info -v` of ROS 2 Jazzy and Kilted, and listed in the tables of Pico-ROS
# (https://github.com/Pico-ROS/Pico-ROS-software) and other programs that speak to rmw_zenoh.
HASHES = {
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "rosgraph_msgs/msg/Clock": "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "RIHS01_"
    "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "nav_msgs/msg/Odometry": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "diagnostic_msgs/msg/DiagnosticArray": "RIHS01_"
    "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    STRING: STRING_HASH,
}


@contextmanager
def streaming(
    port: int | None = None, age_s: float = 0.0, is_replayed: bool = False, **options: Any
) -> Iterator[tuple[Ros2Stream, list[str]]]:
    events: list[str] = []
    now_ns = lambda: START_NS + round(age_s * NS_PER_S)  # noqa: E731
    settings = StreamSettings(ros2_domain=options.pop("domain", 0), host=options.pop("host", None))
    warn = lambda kind, text: events.append(text)  # noqa: E731
    heights_m = options.pop("heights_m", {"ada": 0.1, "bob": None})
    positions = options.pop("positions", None)
    context = StreamContext(settings, {TOPIC}, now_ns, warn, 7, heights_m, is_replayed, positions)
    stream = Ros2Stream(free_port() if port is None else port, context)
    with closing(stream):
        yield stream, events


@contextmanager
def listening(stream: Ros2Stream, *topics: str) -> Iterator[ZenohListener]:
    """A listener whose subscriptions have arrived at the stream."""
    with closing(ZenohListener(stream.port, *topics)) as listener:
        # The router answers after it has read the subscriptions.
        listener.tokens()
        yield listener


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)


@pytest.mark.parametrize("ros_type", HASHES)
def test_type_hashes_are_those_of_ros(ros_type: str) -> None:
    assert type_hash(ros_type) == HASHES[ros_type]


def test_keys_and_tokens_are_those_of_the_design_of_rmw_zenoh() -> None:
    """The texts are the examples of docs/design.md in ros2/rmw_zenoh (jazzy)."""
    talker = Entity(0, "8b20917502ee955ac4476e0266340d5c", "talker")
    key = topic_key(0, "/chatter", STRING, STRING_HASH)
    assert key == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert talker.node_token() == "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/0/NN/%/%/talker"
    assert talker.publisher_token(10, "/chatter", STRING, STRING_HASH, Qos(7)) == (
        "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    )
    # Numbers of rmw/types.h: transient local is 1, best effort is 2.
    assert (str(Qos(1, is_latched=True)), str(Qos(1, is_reliable=False))) == (":1:,1:,:,:,,", "2::,1:,:,:,,")


def test_attachment_is_serialised_as_zenoh_does() -> None:
    """The C++ code of rmw_zenoh serialises two int64 and an array of bytes."""
    number = bytes(range(16))
    expected = zenoh.ext.z_serialize((zenoh.ext.Int64(5), zenoh.ext.Int64(-6), number)).to_bytes()
    assert attachment(5, -6, number) == expected
    assert len(expected) == 33


def test_gid_is_the_hash_of_the_token() -> None:
    """The value for no input is a test vector of xxHash."""
    assert gid("") == struct.pack("<QQ", 0x6001C324468D497F, 0x99AA06D3014798D8)


def test_poses_arrive_with_stamps_frames_and_covariance() -> None:
    """The robot faces along y, drives along y, and turns to the left."""
    log = [tracks(n, replace(track("ada", 1.0, pi / 2 + 0.02 * n), y_m=0.02 * n)) for n in range(4)]
    topics = ("/tf", "/ada/pose", "/ada/odom")
    with streaming() as (stream, events), listening(stream, *topics) as listener:
        send_all(stream, log)
        transforms, poses = listener.messages("/tf", 4), listener.messages("/ada/pose", 4)
        odometry = listener.messages("/ada/odom", 2)
        attached = listener.attachments("/tf")
        tokens = listener.tokens()
    assert events == []
    (row,) = transforms[-1].transforms
    last_ns = START_NS + 3 * STEP_NS
    assert (stamp_ns(row.header), row.header.frame_id, row.child_frame_id) == (last_ns, "map", "ada")
    moved = row.transform.translation
    assert [moved.x, moved.y, moved.z] == pytest.approx([1.0, 0.06, 0.1])
    turn = row.transform.rotation
    yaw = pi / 2 + 0.06
    assert [turn.x, turn.y, turn.z, turn.w] == pytest.approx([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
    assert stamp_ns(poses[-1].header) == last_ns
    covariance = np.reshape(poses[-1].pose.covariance, (6, 6))
    assert covariance[:3, :3] == pytest.approx(np.eye(3) * 1e-4)
    assert np.diag(covariance)[3:] == pytest.approx([1e6] * 3)
    twist = odometry[-1].twist.twist
    assert odometry[-1].child_frame_id == "ada"
    ahead = 0.5 * np.array([np.sin(yaw), np.cos(yaw)])
    assert [twist.linear.x, twist.linear.y] == pytest.approx(ahead, abs=1e-9)
    assert twist.angular.z == pytest.approx(0.5)
    (token,) = [token for token in tokens if "/%tf/" in token]
    rows = [struct.unpack("<qqB16s", data) for data in attached]
    assert [row[0] for row in rows] == [1, 2, 3, 4]
    assert {(length, number) for *_, length, number in rows} == {(16, gid(token))}
    assert abs(rows[0][1] - time.time_ns()) < 60 * NS_PER_S


def test_odometry_has_the_variances_along_the_robot() -> None:
    """The robot faces along y: its velocity along x is to the right."""
    topics = ("/ada/pose", "/ada/odom")
    with streaming() as (stream, _), listening(stream, *topics) as listener:
        send_all(stream, [tracks(0, moving_track("ada", pi / 2))])
        (pose,), (odometry,) = listener.messages("/ada/pose"), listener.messages("/ada/odom")
    twist = odometry.twist
    assert [twist.twist.linear.x, twist.twist.linear.y] == pytest.approx([0.0, -0.5])
    expected = [4e-4, 1e-4, 9e-4, 1e6, 1e6, 0.03**2]
    assert np.diag(np.reshape(twist.covariance, (6, 6))) == pytest.approx(expected)
    for one in (pose.pose, odometry.pose):
        assert np.diag(np.reshape(one.covariance, (6, 6)))[5] == pytest.approx(0.02**2)


def test_tilted_robot_has_its_rotation_and_twist() -> None:
    """nav_msgs: the pose and its covariance are along and about the axes of map, the twist of the robot."""
    topics, sent = ("/tf", "/ada/pose", "/ada/odom"), tilted_track("ada")
    with streaming() as (stream, _), listening(stream, *topics) as listener:
        send_all(stream, [tracks(0, sent)])
        (transforms,), (pose,), (odometry,) = (listener.messages(topic) for topic in topics)
    map_from_robot = Rotation.from_rotvec(TILT_RAD)
    for turn in (transforms.transforms[0].transform.rotation, odometry.pose.pose.orientation):
        quaternion = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
        assert (quaternion.inv() * map_from_robot).magnitude() == pytest.approx(0.0, abs=1e-12)
    for stated in (pose.pose.covariance, odometry.pose.covariance):
        assert np.array_equal(np.reshape(stated, (6, 6)), np.asarray(sent.pose_covariance))
    twist = odometry.twist.twist
    for vector, in_map in ((twist.linear, sent.velocity_m_s), (twist.angular, sent.angular_velocity_rad_s)):
        assert map_from_robot.apply([vector.x, vector.y, vector.z]) == pytest.approx(in_map)
    covariance = np.reshape(odometry.twist.covariance, (6, 6))
    axes = map_from_robot.as_matrix()
    assert axes @ covariance[:3, :3] @ axes.T == pytest.approx(sent.velocity_covariance_m2_s2)
    turning = sent.angular_velocity_covariance_rad2_s2
    assert axes @ covariance[3:, 3:] @ axes.T == pytest.approx(turning)


def test_node_and_publishers_are_in_the_graph() -> None:
    with streaming(is_replayed=True) as (stream, _), listening(stream, "/tf_static") as listener:
        tokens = listener.tokens()
        (floors,) = listener.messages("/tf_static")
    parts = [token.split("/") for token in tokens]
    assert {(part[0], part[1], part[8]) for part in parts} == {("@ros2_lv", "0", "ipsys")}
    assert len({part[4] for part in parts}) == len(parts)
    topics = {(part[9].replace("%", "/"), part[10], part[12]) for part in parts if part[5] == "MP"}
    pose, odometry = (f"{name}_" for name in ("PoseWithCovarianceStamped", "Odometry"))
    assert topics == {
        ("/tf", "tf2_msgs::msg::dds_::TFMessage_", "::,100:,:,:,,"),
        ("/tf_static", "tf2_msgs::msg::dds_::TFMessage_", ":1:,1:,:,:,,"),
        ("/clock", "rosgraph_msgs::msg::dds_::Clock_", "2::,1:,:,:,,"),
        ("/diagnostics", "diagnostic_msgs::msg::dds_::DiagnosticArray_", "::,10:,:,:,,"),
        *((f"/{name}/pose", f"geometry_msgs::msg::dds_::{pose}", "::,10:,:,:,,") for name in ("ada", "bob")),
        *((f"/{name}/odom", f"nav_msgs::msg::dds_::{odometry}", "::,10:,:,:,,") for name in ("ada", "bob")),
    }
    (row,) = floors.transforms
    assert (row.header.frame_id, row.child_frame_id) == ("ada", "ada/floor")
    assert row.transform.translation.z == -0.1


@pytest.mark.slow
def test_stale_and_extrapolated_poses_are_withheld_and_diagnosed() -> None:
    outside = tracks(1, track("bob", 1.0, inside=False))
    with streaming() as (stream, _), listening(stream, "/tf", "/diagnostics") as listener:
        send_all(stream, [tracks(0, track("ada", 1.0)), outside])
        transforms, first = listener.messages("/tf"), listener.messages("/diagnostics")[-1]
    assert [row.child_frame_id for message in transforms for row in message.transforms] == ["ada"]
    assert [(status.name, status.level) for status in first.status] == [("ipsys: ada", 0), ("ipsys: bob", 1)]
    values = {value.key: value.value for value in first.status[0].values}
    assert values == {"session": "7", "age_s": "0.000", "cameras": "red", "sigma_m": "0.0100"}
    late = streaming(age_s=0.6, positions=judged("late"))
    with late as (stream, _), listening(stream, "/tf", "/diagnostics") as listener:
        send_all(stream, [tracks(0, track("ada", 1.0))])
        status = listener.messages("/diagnostics")[-1].status
        assert "/tf" not in listener.topics()
    assert [(row.level, row.message) for row in status] == [
        (3, "no position for 0.6 s"),
        (3, "no camera has seen the robot"),
        (1, "late: 0.4 s. The cause. The remedy"),
    ]


def test_clock_belongs_to_replays_only() -> None:
    with streaming(is_replayed=True) as (stream, _), listening(stream, "/clock") as listener:
        send_all(stream, [Message("", 0, 0, NewSession(8))])
        clock = listener.messages("/clock")[-1].clock
        assert int(clock.sec) * NS_PER_S + int(clock.nanosec) == START_NS
    with streaming() as (stream, _), listening(stream, "/clock", "/diagnostics") as listener:
        listener.messages("/diagnostics")
        assert listener.topics() == {"/diagnostics"}


def test_no_message_comes_in_or_passes_through() -> None:
    """Nodes find each other and connect directly; a client that knows only the router reaches nobody."""
    with streaming() as (stream, _):
        received: list[str] = []
        inner = stream._session.declare_subscriber(
            "**", lambda sample: received.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
        )
        with closing(open_node(stream.port, "client")) as one, closing(open_node(stream.port)) as two:
            heard: list[str] = []
            two.declare_subscriber("0/cmd_vel/**", lambda sample: heard.append("two"))
            time.sleep(0.5)
            for _ in range(5):
                one.put("0/cmd_vel/x/y", b"go")
                one.put("0/tf/x/y", b"lie")
                time.sleep(0.05)
            with closing(open_node(stream.port)) as three:

                def reached() -> bool:
                    three.put("0/cmd_vel/x/y", b"go")
                    return bool(heard)

                assert heard == []
                wait_until(reached, "the second node hears the third one")
        inner.undeclare()  # type: ignore[no-untyped-call]
        assert received == []


def test_second_stream_uses_the_router_that_answers() -> None:
    port = free_port()
    config = zenoh.Config()
    for key, value in {
        "mode": '"router"',
        "listen/endpoints": f'["tcp/127.0.0.1:{port}"]',
        "scouting/multicast/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    with closing(zenoh.open(config)), streaming(port) as (stream, _), listening(stream, "/tf") as listener:
        assert stream.describe() == f"ROS 2 domain 0: every node that reaches the router on port {port}"
        numbers = count()

        def arrives() -> bool:
            """Send a pose: the router tells the stream of a subscriber at any time."""
            send_all(stream, [tracks(next(numbers), track("ada", 1.0))])
            return bool(listener.samples)

        wait_until(arrives, "a pose arrives")
        with pytest.raises(IpsysError, match=f"--ros2: another ipsys is on port {port} already"):
            Ros2Stream(port, StreamContext(StreamSettings(), (), lambda: 0, lambda *_: None, 1))


def test_only_this_machine_can_connect_without_a_host() -> None:
    before = set(exposed(os.getpid()))
    with streaming() as (stream, _):
        assert stream.describe() == f"ROS 2 domain 0, as the router on port {stream.port}: only this machine"
        assert set(exposed(os.getpid())) == before
    with streaming(host="0.0.0.0") as (stream, _):
        assert ("tcp", "0.0.0.0", stream.port) in exposed(os.getpid())
        assert "every computer that reaches 0.0.0.0" in stream.describe()


def refusal(port: int, host: str | None = None, domain: int = 0) -> str:
    settings = StreamSettings(ros2_domain=domain, host=host)
    with pytest.raises(IpsysError) as error, suppress(KeyboardInterrupt):
        Ros2Stream(port, StreamContext(settings, (), lambda: 0, lambda *_: None, 1))
    assert "\n" not in str(error.value)
    return str(error.value)


# Routers of Zenoh need a second each to answer.
@pytest.mark.slow
def test_wrong_ports_hosts_and_domains_are_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert f"port {port} is in use by a program that is not a Zenoh router" in refusal(port)
    with streaming() as (stream, _):
        assert f"another ipsys is on port {stream.port} already" in refusal(stream.port)
        assert "another ipsys" in refusal(stream.port, domain=3)
    assert "--host 192.0.2.77: is not an address of this machine" in refusal(free_port(), "192.0.2.77")
    assert "--ros2-domain 233: give a domain ID from 0 to 232" in refusal(free_port(), domain=233)
