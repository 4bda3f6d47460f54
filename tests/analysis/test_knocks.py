"""Warnings of the live monitor: a knocked camera within a second, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture import live_check
from ipsys_log.capture.live_check import Knock, KnockMonitor
from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Marker, Markers, Message, Position, Positions, ReferenceMarker, Rig
from ipsys_log.messages.events import MODEL_CONTRADICTED
from ipsys_log.statistics.floor_cameras import shift_floor_map
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import in_image, project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import PosedCamera, pose_facing_up, transform

Array = NDArray[np.float64]
Motion = Callable[[str, float], Array]

PLACES = {90: (1.0, 1.62), 91: (3.9, 1.62), 92: (1.0, 3.25), 93: (3.9, 3.25)}
LENGTH_M = 0.2
KNOCK = np.array([0.0, 0.0015, 0.0, 0.0, 0.0, 0.0])
AT_S, LAST_S = 4.0, 8.0
CAMERAS = {
    one.name: PosedCamera.at_pose(one.name, one.lens, one.camera_from_world)
    for one in mount_cameras(LabSettings(seed=3))
}
RIG = Rig("lab", "DICT_4X4_100", LENGTH_M, reference_markers=tuple(map(ReferenceMarker, PLACES)))


def still(_camera: str, _time_s: float) -> Array:
    return np.zeros(6)


def knocked(camera: str, time_s: float) -> Array:
    """Return the motion of a camera that swings for 0.2 s after a knock and stays moved."""
    if camera != "white" or time_s < AT_S:
        return np.zeros(6)
    swing = 2 * np.cos(60 * (time_s - AT_S)) if time_s < AT_S + 0.2 else 0.0
    return KNOCK * (1 + swing)


def frames(
    motion: Motion,
    rate_hz: float,
    places: Callable[[float], dict[int, tuple[float, float]]] = lambda _: PLACES,
) -> Iterator[Message]:
    """Yield the reference markers of cameras that are out of step."""
    rng = np.random.default_rng(5)
    for number in range(round(LAST_S * rate_hz)):
        for offset, (name, camera) in enumerate(CAMERAS.items()):
            time_s = number / rate_hz + 0.011 * offset
            moved, markers = camera.move(motion(name, time_s)), []
            for marker_id, (x_m, y_m) in places(time_s).items():
                points_c = moved.transform(
                    transform(pose_facing_up(x_m, y_m, 0.0, 0.3), marker_corners(LENGTH_M))
                )
                if in_image(points_c, moved.lens).all():
                    px = project(points_c, moved.lens) + rng.normal(0, 0.02, (4, 2))
                    markers.append(Marker(marker_id, px))
            time_ns = round(time_s * NS_PER_S)
            topic = f"/runs/edges/cameras/{name}/markers"
            yield Message(topic, time_ns, time_ns, Markers(time_ns, tuple(markers), 1920, 1080), name)


def positions(
    motion: Motion,
    rate_hz: float,
    bias_m: float = 0.0,
    inside: bool | None = None,
    start_s: float = 0.0,
) -> Iterator[Message]:
    """Yield the positions of a robot on a circle that all cameras see, as models with a bias locate it.

    The robot stands still until ``start_s``.
    """
    rng = np.random.default_rng(6)
    for number in range(round(LAST_S * rate_hz)):
        for offset, (name, camera) in enumerate(CAMERAS.items()):
            time_s = number / rate_hz + 0.011 * offset
            turn = 0.26 / 0.5 * max(time_s - start_s, 0.0)
            point_m = np.array([[2.4 + 0.5 * np.cos(turn), 2.4 + 0.5 * np.sin(turn), 0.0]])
            x_m, y_m = (point_m[:, :2] + shift_floor_map(camera, point_m, motion(name, time_s)))[0]
            x_m += bias_m * np.sin(4 * point_m[0, 0] + 3 * offset) + rng.normal(0, 0.0003)
            y_m += bias_m * np.cos(4 * point_m[0, 1] + 3 * offset) + rng.normal(0, 0.0003)
            time_ns = round(time_s * NS_PER_S)
            one = Position(0, float(x_m), float(y_m), 0.0, inside=inside)
            topic = f"/runs/joint/cameras/{name}/positions"
            yield Message(topic, time_ns, time_ns, Positions(time_ns, (one,)), name)


def warnings(messages: Iterator[Message], rig: Rig = RIG) -> list[Knock]:
    monitor = KnockMonitor(rig)
    return [knock for message in messages for knock in monitor(message)]


@pytest.mark.parametrize("rate_hz", [8.0, 30.0])
def test_knocked_camera_is_named_within_a_second(rate_hz: float) -> None:
    (knock,) = warnings(frames(knocked, rate_hz))
    assert knock.camera == "white"
    assert AT_S < knock.time_ns / NS_PER_S < AT_S + 1.0
    assert "camera white has moved" in knock.text


def test_model_of_another_lab_is_named_once_for_each_pair() -> None:
    """The model has each camera where it hung in the other lab: positions are turned about the camera."""
    turned = {"black": 0.0, "red": 0.3, "white": 0.1}
    knocks = warnings(positions(lambda camera, _: np.array([0, turned[camera], 0, 0, 0, 0]), 8.0))
    assert {knock.kind for knock in knocks} == {MODEL_CONTRADICTED}
    pairs = sorted(knock.text.split(" place ")[0] for knock in knocks)
    assert pairs == ["cameras black and red", "cameras black and white", "cameras red and white"]
    assert max(knock.time_ns for knock in knocks) < 2 * NS_PER_S


def test_still_cameras_cause_no_warning() -> None:
    assert warnings(frames(still, 30.0)) == []


def test_marker_that_two_cameras_see_moving_is_no_knock() -> None:
    def shifted(time_s: float) -> dict[int, tuple[float, float]]:
        return {**PLACES, 90: (1.02, 1.62)} if time_s > AT_S else PLACES

    assert warnings(frames(still, 20.0, shifted)) == []


def test_slow_warming_is_no_knock() -> None:
    def warming(_camera: str, time_s: float) -> Array:
        return KNOCK * time_s / LAST_S

    assert warnings(frames(warming, 20.0)) == []


def test_overlap_names_a_knocked_camera_without_references() -> None:
    def turned(camera: str, time_s: float) -> Array:
        return np.array([0.0, 0.0175, 0, 0, 0, 0]) * (camera == "white" and time_s >= AT_S)

    first, *_ = warnings(positions(turned, 30.0), Rig("lab", "DICT_4X4_100", LENGTH_M))
    assert AT_S < first.time_ns / NS_PER_S < AT_S + 1.0
    assert "white" in first.text


@pytest.mark.parametrize("bias_m", [0.0, 0.006, 0.020])
@pytest.mark.parametrize("turn_rad", [0.0, 0.004, 0.0175])
def test_extents_leave_out_no_warning(
    bias_m: float, turn_rad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The extents of the differences only save time: all medians give the same warnings."""

    def turned(camera: str, time_s: float) -> Array:
        return np.array([0.0, turn_rad, 0, 0, 0, 0]) * (camera == "white" and time_s >= AT_S)

    rig = Rig("lab", "DICT_4X4_100", LENGTH_M)
    quick = warnings(positions(turned, 10.0, bias_m), rig)
    monkeypatch.setattr(live_check._History, "is_within", lambda history, extent: False)
    assert quick == warnings(positions(turned, 10.0, bias_m), rig)


@pytest.mark.parametrize("rate_hz", [10.0, 30.0])
def test_models_that_disagree_over_the_floor_cause_no_warning(rate_hz: float) -> None:
    assert warnings(positions(still, rate_hz, bias_m=0.006), Rig("lab", "DICT_4X4_100", LENGTH_M)) == []


def test_robot_that_starts_to_drive_causes_no_warning() -> None:
    rows = positions(still, 30.0, bias_m=0.020, start_s=AT_S)
    assert warnings(rows, Rig("lab", "DICT_4X4_100", LENGTH_M)) == []


def test_positions_outside_of_their_model_cause_no_warning() -> None:
    def turned(camera: str, time_s: float) -> Array:
        return np.array([0.0, 0.0175, 0, 0, 0, 0]) * (camera == "white" and time_s >= AT_S)

    assert warnings(positions(turned, 30.0, inside=False), Rig("lab", "DICT_4X4_100", LENGTH_M)) == []
