"""MAVLink stream: pymavlink as the autopilot gets poses in its own axes, and disturbs nothing."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from math import isnan, pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common
from scipy.spatial.transform import Rotation

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message
from ipsys_log.sinks.streams.mavlink import MavlinkStream, parse_endpoint
from ipsys_log.sinks.streams.poses import NewSession, PoseSource
from tests.sinks.autopilots import ardupilot, px4
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

_LIMIT_S = 240.0
NOW_NS = START_NS + 7


class Autopilot:
    """The receiving side, with the library of MAVLink; it listens on a port of its own."""

    def __init__(self) -> None:
        self.link: Any = mavutil.mavlink_connection("udpin:127.0.0.1:0", dialect="common", source_component=1)
        self.target = f"127.0.0.1:{self.link.port.getsockname()[1]}"

    @property
    def sender(self) -> Any:
        """The address of the stream."""
        (address,) = self.link.clients
        return address

    def close(self) -> None:
        self.link.close()

    def next(self, kind: str) -> Any:
        end_s = time.monotonic() + _LIMIT_S
        while time.monotonic() < end_s:
            message = self.link.recv_match(type=kind, blocking=True, timeout=1)
            if message is not None:
                return message
        raise AssertionError(f"no {kind}")


@pytest.fixture
def autopilot(monkeypatch: pytest.MonkeyPatch) -> Iterator[Autopilot]:
    monkeypatch.setenv("MAVLINK20", "1")
    with closing(Autopilot()) as receiving:
        yield receiving


@contextmanager
def streaming(
    autopilot: Autopilot, message: str = "", north_rad: float = pi / 2, positions: Any = None
) -> Iterator[tuple[MavlinkStream, list[str]]]:
    events: list[str] = []
    poses = PoseSource({TOPIC}, lambda: START_NS, 300, ["ada"], positions=positions)
    endpoint = parse_endpoint(f"ada={autopilot.target}{message}")
    stream = MavlinkStream(
        endpoint, None, poses, lambda: NOW_NS, lambda kind, text: events.append(text), north_rad
    )
    with closing(stream):
        yield stream, events


def test_pose_arrives_in_the_axes_of_the_autopilot(autopilot: Autopilot) -> None:
    """The robot is 1 m east and 2 m north, 0.1 m up, faces east, and drives to the east."""
    with streaming(autopilot) as (stream, _):
        send_all(stream, [tracks(n, track("ada", 1 + 0.02 * (n - 3), 0.0)) for n in range(4)])
        *_, last = [autopilot.next("ODOMETRY") for _ in range(4)]
    assert last.time_usec == (START_NS + 3 * STEP_NS) // 1000
    assert (last.frame_id, last.child_frame_id) == (
        mavutil.mavlink.MAV_FRAME_LOCAL_FRD,
        mavutil.mavlink.MAV_FRAME_BODY_FRD,
    )
    assert [last.x, last.y, last.z] == pytest.approx([2.0, 1.0, -0.1])
    # A yaw of 90 degrees, clockwise from north.
    assert list(last.q) == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], abs=1e-6)
    assert [last.vx, last.vy, last.vz] == pytest.approx([0.5, 0.0, 0.0], abs=1e-5)
    assert last.yawspeed == pytest.approx(0.0, abs=1e-6)
    assert isnan(last.rollspeed)
    assert isnan(last.velocity_covariance[0])
    assert last.reset_counter == 300 % 256


@pytest.mark.parametrize(("north_rad", "expected"), [(0.0, [1.0, -2.0]), (pi, [-1.0, 2.0]), (pi / 4, None)])
def test_direction_of_north_is_a_setting(
    autopilot: Autopilot, north_rad: float, expected: list[float] | None
) -> None:
    with streaming(autopilot, "/vision", north_rad) as (stream, _):
        send_all(stream, [tracks(0, track("ada", 1.0, 0.3))])
        message = autopilot.next("VISION_POSITION_ESTIMATE")
    if expected is not None:
        assert [message.x, message.y] == pytest.approx(expected, abs=1e-6)
    assert np.hypot(message.x, message.y) == pytest.approx(np.sqrt(5))
    assert message.yaw == pytest.approx(north_rad - 0.3)
    assert (message.roll, message.pitch) == (0.0, 0.0)


def test_turn_to_the_left_is_a_negative_yaw_rate(autopilot: Autopilot) -> None:
    with streaming(autopilot) as (stream, _):
        send_all(stream, [tracks(n, track("ada", 1.0, 0.04 * n)) for n in range(4)])
        *_, last = [autopilot.next("ODOMETRY") for _ in range(4)]
    assert last.yawspeed == pytest.approx(-1.0, abs=1e-5)


def test_covariance_is_turned_and_unknown_begins_with_nan(autopilot: Autopilot) -> None:
    known = replace(track("ada", 1.0), covariance_m2=np.diag([1e-4, 4e-4, 9e-4]), heading_sigma_rad=0.02)
    unknown = replace(track("ada", 1.0), covariance_m2=None)
    with streaming(autopilot) as (stream, _):
        send_all(stream, [tracks(0, known), tracks(1, unknown)])
        first, second = [autopilot.next("ODOMETRY").pose_covariance for _ in range(2)]
    # The upper triangle by rows: x, y and z are at 0, 6 and 11; x is north, the y of the lab.
    assert [first[n] for n in (0, 6, 11)] == pytest.approx([4e-4, 1e-4, 9e-4])
    assert [first[n] for n in (15, 18, 20)] == pytest.approx([0.02**2] * 3)
    assert np.isfinite(first).all()
    assert isnan(second[0])
    assert [second[n] for n in (15, 18, 20)] == pytest.approx([0.1**2] * 3)


TRACKS = {
    "all_known": moving_track("ada", 0.4),
    "no_velocity": replace(track("ada", 1.0, 0.4), heading_sigma_rad=0.02),
    "no_heading_sigma": track("ada", 1.0, 0.4),
    "no_covariance": replace(moving_track("ada", 0.4), covariance_m2=None, velocity_covariance_m2_s2=None),
    "broken_covariance": replace(moving_track("ada", 0.4), covariance_m2=np.full((3, 3), np.nan)),
    "facing_back": moving_track("ada", -np.pi),
    "tilted": tilted_track("ada"),
    "tilted_without_covariance": replace(tilted_track("ada"), pose_covariance=None),
}


@pytest.mark.parametrize("message", ["ODOMETRY", "VISION_POSITION_ESTIMATE"])
@pytest.mark.parametrize("name", TRACKS)
def test_both_autopilots_use_position_and_yaw(autopilot: Autopilot, message: str, name: str) -> None:
    sent = TRACKS[name]
    assert sent.heading_rad is not None
    with streaming(autopilot, "" if message == "ODOMETRY" else "/vision") as (stream, _):
        send_all(stream, [tracks(0, sent)])
        received = autopilot.next(message)
    for reading in (px4(received), ardupilot(received)):
        assert reading.internal_errors == 0
        assert reading.position_m == pytest.approx((sent.y_m, sent.x_m, -sent.z_m))
        assert reading.yaw_rad is not None
        assert np.cos(reading.yaw_rad - (pi / 2 - sent.heading_rad)) == pytest.approx(1.0)
        has_velocity = message == "ODOMETRY" and sent.velocity_m_s is not None
        assert (reading.velocity_m_s is not None) == has_velocity
    is_known = name not in ("no_covariance", "broken_covariance")
    assert (px4(received).sigma_m is not None) == is_known
    if name != "tilted":
        assert px4(received).yaw_sigma_rad == pytest.approx(0.1 if name == "no_heading_sigma" else 0.02)
    # ArduPilot: 0 is "take the noise floors".
    assert (ardupilot(received).sigma_m != (0.0,)) == is_known
    assert received.reset_counter == 300 % 256
    assert getattr(received, "quality", 0) == 0  # unknown: both use it, unless they require a quality


@pytest.mark.parametrize("name", ["ODOMETRY", "VISION_POSITION_ESTIMATE"])
def test_each_field_of_a_message_is_in_the_documents(name: str) -> None:
    text = (Path(__file__).parents[2] / "docs/streams.md").read_text()
    table = text.partition(f"| field of `{name}` |")[2].partition("\n\n")[0]
    (kind,) = [kind for kind in common.mavlink_map.values() if kind.msgname == name]
    for field in kind.fieldnames:
        assert f"`{field}`" in table, field


def test_covariance_of_the_velocity_is_along_the_robot(autopilot: Autopilot) -> None:
    """The robot faces along y, which is north: its velocity along x is to the right."""
    with streaming(autopilot) as (stream, _):
        send_all(stream, [tracks(0, moving_track("ada", np.pi / 2))])
        last = autopilot.next("ODOMETRY")
    assert [last.vx, last.vy] == pytest.approx([0.0, 0.5], abs=1e-6)
    # The diagonal of the upper triangle by rows.
    diagonal = [last.velocity_covariance[n] for n in (0, 6, 11, 20)]
    assert diagonal == pytest.approx([4e-4, 1e-4, 9e-4, 0.03**2])
    assert last.pose_covariance[20] == pytest.approx(0.02**2)
    assert np.isfinite(last.velocity_covariance).all()


def test_tilted_robot_has_its_rotation_in_the_axes_of_the_autopilot(autopilot: Autopilot) -> None:
    """North is y, east is x; the covariance is that of roll, pitch and yaw of many drawn poses."""
    sent = tilted_track("ada")
    with streaming(autopilot) as (stream, _), streaming(autopilot, "/vision") as (other, _):
        send_all(stream, [tracks(0, sent)])
        send_all(other, [tracks(0, sent)])
        odometry, vision = autopilot.next("ODOMETRY"), autopilot.next("VISION_POSITION_ESTIMATE")
    ned_from_lab = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    errors = np.random.default_rng(0).multivariate_normal(
        np.zeros(6), np.asarray(sent.pose_covariance), 100_000
    )
    drawn = Rotation.from_rotvec([*errors[:, 3:], [0, 0, 0]]) * Rotation.from_rotvec(TILT_RAD)
    bodies = Rotation.from_matrix(ned_from_lab @ drawn.as_matrix() @ np.diag([1, -1, -1]))
    w, *xyz = odometry.q
    assert (Rotation.from_quat([*xyz, w]).inv() * bodies[-1]).magnitude() == pytest.approx(0.0, abs=1e-6)
    yaw_pitch_roll = bodies.as_euler("ZYX")
    assert [vision.yaw, vision.pitch, vision.roll] == pytest.approx(yaw_pitch_roll[-1], abs=1e-6)
    to_body = bodies[-1].inv()
    assert [odometry.vx, odometry.vy, odometry.vz] == pytest.approx(
        to_body.apply(ned_from_lab @ sent.velocity_m_s), abs=1e-6
    )
    assert [odometry.rollspeed, odometry.pitchspeed, odometry.yawspeed] == pytest.approx(
        to_body.apply(ned_from_lab @ sent.angular_velocity_rad_s), abs=1e-6
    )
    axes = to_body.as_matrix() @ ned_from_lab
    turning = axes @ sent.angular_velocity_covariance_rad2_s2 @ axes.T
    assert odometry.velocity_covariance[15:] == pytest.approx(turning[np.triu_indices(3)], rel=1e-5)
    state = np.column_stack([errors[:, :3] @ ned_from_lab.T, np.unwrap(yaw_pitch_roll[:-1, ::-1], axis=0)])
    upper = np.cov(state.T)[np.triu_indices(6)]
    for stated in (odometry.pose_covariance, vision.covariance):
        assert stated == pytest.approx(upper, rel=0.03, abs=2e-6)


def test_new_session_raises_the_reset_counter(autopilot: Autopilot) -> None:
    with streaming(autopilot) as (stream, _):
        restart = Message("", 0, 0, NewSession(301))
        send_all(stream, [tracks(5, track("ada", 1.0)), restart, tracks(0, track("ada", 2.0))])
        counters = [autopilot.next("ODOMETRY").reset_counter for _ in range(2)]
    assert counters == [300 % 256, 301 % 256]


def test_only_good_poses_of_the_robot_are_sent(autopilot: Autopilot) -> None:
    rows = [
        tracks(-30, track("ada", 1.0)),
        tracks(0, track("bob", 2.0)),
        tracks(1, track("ada", 3.0, inside=False)),
        tracks(2, track("ada", 4.0, None)),
        tracks(3, track("ada", 5.0)),
    ]
    with streaming(autopilot) as (stream, _):
        send_all(stream, rows)
        assert autopilot.next("ODOMETRY").y == 5.0


def test_time_is_answered_and_garbage_is_not(autopilot: Autopilot) -> None:
    with streaming(autopilot) as (stream, events):
        beat = autopilot.next("HEARTBEAT")
        assert beat.type == mavutil.mavlink.MAV_TYPE_ONBOARD_CONTROLLER
        for data in (b"", b"\xfd", b"\xfd" * 300, bytes(range(256)) * 5, b"\xfe\x09\x00"):
            autopilot.link.port.sendto(data, autopilot.sender)
        autopilot.link.mav.command_long_send(
            1, 197, mavutil.mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, *[0] * 8
        )
        autopilot.link.mav.timesync_send(5, 6)  # an answer, not a request
        autopilot.link.mav.timesync_send(0, 123456789)
        answer = autopilot.next("TIMESYNC")
        assert (answer.tc1, answer.ts1) == (NOW_NS, 123456789)
        assert autopilot.link.recv_match(type="COMMAND_ACK", blocking=False) is None
        send_all(stream, [tracks(0, track("ada", 1.0))])
        assert autopilot.next("ODOMETRY").y == 1.0
    assert events == []


@pytest.mark.parametrize("state", ["live", "late", "stale"])
def test_heartbeat_has_the_state_of_the_positions(autopilot: Autopilot, state: str) -> None:
    expected = mavutil.mavlink.MAV_STATE_ACTIVE if state == "live" else mavutil.mavlink.MAV_STATE_CRITICAL
    with streaming(autopilot, positions=judged(state)):
        assert autopilot.next("HEARTBEAT").system_status == expected


def test_request_of_another_address_is_not_answered(autopilot: Autopilot) -> None:
    with streaming(autopilot), closing(Autopilot()) as other:
        autopilot.next("HEARTBEAT")
        request = other.link.mav.timesync_encode(0, 5)
        other.link.port.sendto(request.pack(other.link.mav), autopilot.sender)
        autopilot.link.mav.timesync_send(0, 6)
        assert autopilot.next("TIMESYNC").ts1 == 6


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("127.0.0.1:14550", "write ROBOT=HOST:PORT"),
        ("ada=", "write ROBOT=HOST:PORT"),
        ("ada=127.0.0.1:14550/pose", "message 'pose' is not known; use odometry or vision"),
    ],
)
def test_wrong_endpoints_are_refused(text: str, words: str) -> None:
    with pytest.raises(IpsysError, match=words):
        parse_endpoint(text)
