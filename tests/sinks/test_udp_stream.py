"""UDP stream: the receiver of the documentation gets the poses, and drops old, foreign and forged ones."""

import hashlib
import hmac
import json
import re
import runpy
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ipsys_log as ipsys
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message
from ipsys_log.sinks.streams.poses import NewSession, PoseSource
from ipsys_log.sinks.streams.ros2_messages import encode_odometry, type_hash
from ipsys_log.sinks.streams.udp import UdpStream, encode_pose
from ipsys_log.units import NS_PER_S
from tests.conftest import ROOT
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
    write_tracks,
)

KEY = b"0123456789abcdef"
Receive = Callable[[socket.socket, bytes], Iterator[Any]]


def receiver() -> Receive:
    """Return the function of the documentation; it shares no code with the sender."""
    text = (ROOT / "docs/streams.md").read_text()
    (block,) = re.findall(r"<!-- receiver -->\n```python\n(.*?)```\n<!-- end -->", text, re.DOTALL)
    assert len([line for line in block.splitlines() if line.strip()]) <= 20
    names: dict[str, Any] = {}
    exec(block, names)
    receive: Receive = names["receive"]
    return receive


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "examples" / "udp" / name))


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        yield sock


def source(age_s: float = 0.0, **options: Any) -> PoseSource:
    return PoseSource({TOPIC}, lambda: START_NS + round(age_s * NS_PER_S), 7, **options)


def poses_of(messages: Sequence[Message], poses: PoseSource | None = None) -> list[Any]:
    reading = poses or source()
    return [pose for message in messages for pose in reading.read(message)]


def received(listening: socket.socket, datagrams: Sequence[bytes], key: bytes = b"") -> list[Any]:
    """Return the poses that the receiver accepts before its first time-out."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            sender.sendto(datagram, listening.getsockname())
    return list(iter(receiver()(listening, key).__next__, None))


def test_receiver_gets_the_poses_of_a_played_log(tmp_path: Path, listening: socket.socket) -> None:
    log = write_tracks(tmp_path / "x.mcap")
    target = f"127.0.0.1:{listening.getsockname()[1]}"
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    with ipsys.play(log, rate=10, udp=[target]) as player:
        player.wait()
    poses = received(listening, [])
    assert [pose["seq"] for pose in poses] == list(range(1, 101))
    assert {pose["session"] for pose in poses} == {player.session}
    of_ada = [pose for pose in poses if pose["robot"] == "ada"]
    assert [pose["time_ns"] for pose in of_ada] == [START_NS + n * STEP_NS for n in range(50)]
    assert [pose["x_m"] for pose in of_ada] == pytest.approx([1 + 0.01 * n for n in range(50)])
    assert of_ada[-1]["vx_m_s"] == pytest.approx(0.25, abs=1e-6)
    assert of_ada[0]["covariance_m2"] == pytest.approx((np.eye(3) * 1e-4).ravel().tolist())
    assert of_ada[0]["outside"] is False


def test_datagram_says_whether_all_positions_are_late() -> None:
    datagrams = [
        json.loads(encode_pose(pose))
        for options in ({}, {"positions": judged("live")}, {"positions": judged("late")})
        for pose in poses_of([tracks(0, track("ada", 1.0))], source(**options))
    ]
    assert [datagram.get("late") for datagram in datagrams] == [None, False, True]


def test_receiver_drops_old_repeated_and_foreign_datagrams(listening: socket.socket) -> None:
    datagrams = [encode_pose(pose) for pose in poses_of([tracks(n, track("ada", n)) for n in range(4)])]
    foreign = [b"", b"{", b"[1]", b"\xff\xfe", b'{"ipsys":1}', b'{"ipsys":1,"session":"9","seq":[]}', b"7"]
    foreign += [b'{"ipsys":1,"session":1e999,"seq":1}', b"[" * 2000, b"\n" * 100]
    foreign += [json.dumps({"ipsys": 2, "session": 8, "seq": 1}).encode()]
    sent = [datagrams[0], *foreign, datagrams[2], datagrams[2], datagrams[1], datagrams[3]]
    assert [pose["seq"] for pose in received(listening, sent)] == [1, 3, 4]


def test_foreign_datagrams_do_not_delay_the_stop(listening: socket.socket) -> None:
    ended = threading.Event()

    def disturb() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not ended.wait(0.02):
                sender.sendto(b"{}", listening.getsockname())

    thread = threading.Thread(target=disturb, daemon=True)
    thread.start()
    try:
        assert next(receiver()(listening, b"")) is None
    finally:
        ended.set()
        thread.join()


def test_receiver_follows_a_new_session_and_not_an_old_one(listening: socket.socket) -> None:
    poses = source()
    (old,) = poses_of([tracks(5, track("ada", 5.0))], poses)
    (new,) = poses_of([Message("", 0, 0, NewSession(8)), tracks(0, track("ada", 1.0))], poses)
    assert (new.session, new.sequence) == (8, 1)
    late = replace(old, sequence=99)
    sent = [encode_pose(old), encode_pose(new), encode_pose(late)]
    assert [pose["x_m"] for pose in received(listening, sent)] == [5.0, 1.0]


def test_receiver_with_a_key_drops_forged_datagrams(listening: socket.socket) -> None:
    first, second, third = poses_of([tracks(n, track("ada", n)) for n in range(3)])
    changed = encode_pose(second, KEY).replace(b'"x_m":1', b'"x_m":9')
    other = encode_pose(second, b"another key of 16")
    sent = [encode_pose(first, KEY), changed, other, encode_pose(second), encode_pose(third, KEY)]
    assert [pose["x_m"] for pose in received(listening, sent, KEY)] == [0.0, 2.0]


def test_signature_is_the_hmac_of_rfc_2104() -> None:
    (pose,) = poses_of([tracks(0, track("ada", 1.0))])
    body, code = encode_pose(pose, KEY).split(b"\n")
    inner = hashlib.sha256(bytes(b ^ 0x36 for b in KEY.ljust(64, b"\0")) + body).digest()
    outer = hashlib.sha256(bytes(b ^ 0x5C for b in KEY.ljust(64, b"\0")) + inner).hexdigest()
    assert code.decode() == outer
    assert hmac.compare_digest(outer, hmac.new(KEY, body, "sha256").hexdigest())


def test_old_and_extrapolated_poses_are_marked() -> None:
    (fresh,) = poses_of([tracks(0, track("ada", 1.0))], source(age_s=0.4))
    (stale,) = poses_of([tracks(0, track("ada", 1.0))], source(age_s=0.6))
    (strict,) = poses_of([tracks(0, track("ada", 1.0))], source(age_s=0.4, stale_s=0.3))
    assert [pose.is_stale for pose in (fresh, stale, strict)] == [False, True, True]
    assert json.loads(encode_pose(stale))["stale"] is True
    assert json.loads(encode_pose(stale))["age_s"] == pytest.approx(0.6)
    outside, unknown = poses_of(
        [tracks(0, track("ada", 1.0, inside=False)), tracks(1, track("ada", 1.0, inside=None))]
    )
    assert json.loads(encode_pose(outside))["outside"] is True
    assert "outside" not in json.loads(encode_pose(unknown))
    assert [pose.is_good for pose in (fresh, stale, outside, unknown)] == [True, False, False, True]


def test_pose_that_arrives_late_is_not_sent() -> None:
    log = [tracks(n, track("ada", float(n))) for n in (0, 2, 1, 2, 3)]
    assert [pose.track.x_m for pose in poses_of(log)] == [0.0, 2.0, 2.0, 3.0]


def test_poses_without_numbers_are_not_sent() -> None:
    log = [tracks(0, track("ada", float("nan"))), tracks(1, track("ada", 1.0, float("inf")))]
    log += [tracks(2, replace(tilted_track("ada"), rotation_rad=np.array([0.0, np.nan, 0.0])))]
    assert poses_of(log) == []
    broken = replace(track("ada", 1.0), covariance_m2=np.full((3, 3), np.nan))
    (pose,) = poses_of([tracks(0, broken)])
    assert "covariance_m2" not in json.loads(encode_pose(pose))


def test_uncertainty_of_velocity_and_heading_is_sent() -> None:
    (pose,) = poses_of([tracks(0, moving_track("ada", 0.0))])
    fields = json.loads(encode_pose(pose))
    assert fields["velocity_covariance_m2_s2"] == pytest.approx(np.diag([1e-4, 4e-4, 9e-4]).ravel().tolist())
    assert (fields["heading_sigma_rad"], fields["yaw_sigma_rad_s"]) == (0.02, 0.03)


def test_tilted_robot_has_further_fields() -> None:
    (pose,) = poses_of([tracks(0, sent := tilted_track("ada"))])
    body = encode_pose(pose, KEY)
    assert len(body) < 1472  # one packet of Ethernet
    fields = json.loads(body.partition(b"\n")[0])
    turned = Rotation.from_quat(fields["quaternion"]).as_rotvec()
    assert turned == pytest.approx(TILT_RAD, abs=1e-5)
    assert fields["pose_covariance"] == pytest.approx(np.ravel(np.asarray(sent.pose_covariance)), rel=1e-3)
    assert fields["angular_rad_s"] == [0.3, -0.4, 0.1]
    (level,) = poses_of([tracks(0, moving_track("ada", 0.0))])
    assert not {"quaternion", "pose_covariance", "angular_rad_s"} & set(json.loads(encode_pose(level)))


def test_example_of_the_crazyflie_sends_good_poses_to_it() -> None:
    """The packet of cflib has the command 8, position and quaternion."""
    crazyflie = pytest.importorskip("cflib.crazyflie").Crazyflie()
    packets: list[Any] = []
    crazyflie.send_packet = packets.append
    log = [tracks(0, track("ada", 1.0)), tracks(1, tilted_track("ada"))]
    log.append(tracks(2, replace(tilted_track("ada"), inside=False)))
    received = [json.loads(encode_pose(pose)) for pose in poses_of(log)]
    example("crazyflie.py")["follow"](crazyflie, [None, *received])
    (packet,) = packets
    command, *pose = struct.unpack("<B7f", packet.data)
    assert (packet.port, packet.channel, command) == (6, 1, 8)
    assert pose == pytest.approx([1.0, 2.0, 0.1, *Rotation.from_rotvec(TILT_RAD).as_quat()], abs=1e-6)


@pytest.mark.filterwarnings("ignore:module .sre_:DeprecationWarning")  # of a library of ROS 2
def test_example_for_dds_publishes_odometry_to_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real rclpy reads the bytes of the stream of ROS 2, too."""
    rclpy = pytest.importorskip("rclpy")
    kind = pytest.importorskip("nav_msgs.msg").Odometry
    deserialize_message = pytest.importorskip("rclpy.serialization").deserialize_message
    poses = poses_of([tracks(0, tilted_track("ada")), tracks(1, moving_track("ada", 0.4))])
    expected = [deserialize_message(encode_odometry(pose, pose.velocity), kind) for pose in poses]
    messages: dict[int, Any] = {}
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    try:
        node, other = rclpy.create_node("ipsys"), rclpy.create_node("robot")
        other.create_subscription(
            kind, "/ada/odom", lambda m: messages.update({m.header.stamp.nanosec: m}), 10
        )

        def received() -> Iterator[Any]:
            while len(messages) < len(poses):  # until the subscription is found
                for pose in poses:
                    yield json.loads(encode_pose(pose))
                    rclpy.spin_once(other, timeout_sec=0.05)

        example("ros2_dds.py")["publish"](node, received())
        (info, *_) = node.get_publishers_info_by_topic("/ada/odom")
        assert str(info.topic_type_hash) == type_hash("nav_msgs/msg/Odometry")
    finally:
        rclpy.shutdown()
    for known, (_, message) in zip(expected, sorted(messages.items()), strict=True):
        assert (message.header, message.child_frame_id) == (known.header, "ada")
        for place in ("pose.pose.position", "pose.pose.orientation", "twist.twist.linear"):
            found, stated = (attrgetter(place)(one) for one in (message, known))
            for axis in stated.get_fields_and_field_types():
                assert getattr(found, axis) == pytest.approx(getattr(stated, axis), abs=2e-6), place
    assert messages[0].pose.covariance == pytest.approx(expected[0].pose.covariance, rel=1e-3)


def test_velocity_is_the_slope_over_the_turn_of_a_heading() -> None:
    headings = [(3.0 + 0.04 * n + np.pi) % (2 * np.pi) - np.pi for n in range(10)]
    log = [tracks(n, track("ada", 0.02 * n, heading)) for n, heading in enumerate(headings)]
    poses = poses_of(log)
    assert [pose.velocity is None for pose in poses[:3]] == [True, True, False]
    assert poses[-1].velocity.x_m_s == pytest.approx(0.5)
    assert poses[-1].velocity.yaw_rad_s == pytest.approx(1.0)
    gap = poses_of([*log, tracks(100, track("ada", 7.0))])
    assert gap[-1].velocity is None


def test_only_the_named_robots_are_sent() -> None:
    assert {pose.track.robot for pose in poses_of([tracks(0)], source(robots=["bob"]))} == {"bob"}


def test_multicast_stays_on_this_machine_without_a_host() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as group:
        group.bind(("239.255.0.1", 0))
        membership = socket.inet_aton("239.255.0.1") + socket.inet_aton("127.0.0.1")
        group.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        group.settimeout(240)
        target = f"239.255.0.1:{group.getsockname()[1]}"
        stream = UdpStream(target, None, source(), lambda kind, text: None)
        assert stream.describe() == f"UDP {target}: only this machine"
        send_all(stream, [tracks(0, track("ada", 1.0))])
        stream.close()
        assert json.loads(group.recv(2048))["x_m"] == 1.0


def test_lost_datagrams_are_counted_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(socket.socket):
        def sendto(self, *_: Any) -> int:
            raise BlockingIOError

    monkeypatch.setattr(socket, "socket", Full)
    events: list[tuple[str, str]] = []
    stream = UdpStream("127.0.0.1:9", None, source(), lambda kind, text: events.append((kind, text)))
    send_all(stream, [tracks(n, track("ada", 1.0)) for n in range(25)])
    stream.close()
    assert {kind for kind, _ in events} == {"sink_dropped"}
    assert [text.split("(")[0] for _, text in events] == [
        f"UDP 127.0.0.1:9: {count} dropped " for count in ("1 message", "10 messages", "25 messages")
    ]


@pytest.mark.parametrize(
    ("target", "host", "text"),
    [
        ("10.0.0.1:9870", None, "is another machine; to send positions into the network, add --host"),
        ("lab", None, "is not an address; write HOST:PORT"),
        ("127.0.0.1:0", None, "is not an address"),
        ("127.0.0.1:70000", None, "is not an address"),
        ("no.such.host.invalid:9870", None, "the host 'no.such.host.invalid' is not known"),
        ("10.0.0.1:9870", "192.0.2.77", "--host 192.0.2.77: is not an address of this machine"),
        ("255.255.255.255:9870", "0.0.0.0", "cannot be reached from 0.0.0.0"),
    ],
)
def test_wrong_addresses_are_refused(target: str, host: str | None, text: str) -> None:
    with pytest.raises(IpsysError) as error:
        UdpStream(target, host, source(), lambda kind, text: None)
    assert text in str(error.value)
    assert "\n" not in str(error.value)
