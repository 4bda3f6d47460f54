"""Calibration of a carried body: exactness, uncertainty, and the faults that it names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.body_calibration import BodyCalibration, calibrate_body
from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Marker, Markers, Message, Rig, RigMarker
from ipsys_log.vision.bodies import body_shapes, pose_from_rpy
from ipsys_log.vision.poses import make_pose, rotation, rotation_vector, transform
from tests.joint.small_lab import Array, make_lab
from tests.joint.test_locate import DRONE, see_corners

TRUE = replace(
    DRONE,
    markers=(
        *DRONE.markers,
        RigMarker(3, 0.1, "drone", xyz_m=(-0.12, 0.1, 0.02), rpy_rad=(0.2, 0.3, 2.0)),
    ),
)
# The poses are unknown before the calibration.
RIG = replace(TRUE, markers=tuple(RigMarker(m.id, 0.1, "drone") for m in TRUE.markers))
ALL = (0, 1, 2, 3)
ROW_S = 31e-6


@pytest.fixture(scope="module")
def fit() -> JointFit:
    return fit_jointly(make_lab(4, points=20)[0])


@pytest.fixture(scope="module")
def cameras(fit: JointFit) -> dict[str, JointModel]:
    models = build_models(fit)
    return {name: replace(model.without_modes(), corner_floor_px=0.0) for name, model in models.items()}


def carry(
    cameras: Mapping[str, JointModel],
    sigma_px: float = 0.01,
    seed: int = 1,
    sides: Sequence[float] = (1.0, 1.0, 1.0, 1.0),
    groups: Sequence[tuple[int, ...]] = (ALL,),
    loose_m: float = 0.0,
    count: int = 60,
    speed_m_s: float = 0.4,
) -> list[Message]:
    """Return the markers of a body that moves under cameras with a rolling shutter.

    It has up to ``speed_m_s`` along each axis. The second camera is 2 ms behind the first one. ``sides`` are
    factors on the nominal ones. The frames show the ``groups`` of markers in turn. Marker 2 moves by
    ``loose_m`` after half of the frames.
    """
    rng, messages = np.random.default_rng(seed), []
    corners_m = body_shapes(TRUE)[0].corners_m
    for number in range(count):
        turn = rotation(np.array([0.0, 0.0, rng.uniform(-3, 3)])) @ rotation(rng.uniform(-0.5, 0.5, 3))
        place_m, speed = rng.uniform((1.8, 1.9, 0.1), (3.0, 2.9, 0.9)), speed_m_s * rng.uniform(-1, 1, 3)
        for camera, delay_s in zip(cameras, (0.0, 0.002), strict=True):
            stamp_ns, markers = number * 1_000_000_000 + round(delay_s * 1e9), []
            for marker_id in groups[number % len(groups)]:
                middle_m = corners_m[marker_id].mean(axis=0)
                own_m = middle_m + (corners_m[marker_id] - middle_m) * sides[marker_id]
                own_m[:, 2] += loose_m * (marker_id == 2 and number > count / 2)
                offset_ns = 0
                for _ in range(4):
                    pose = make_pose(turn, place_m + speed * (delay_s + offset_ns / 1e9))
                    pixels = see_corners(cameras[camera], transform(pose, own_m))[0]
                    offset_ns = round(float(pixels[:, 1].mean()) * ROW_S * 1e9)
                if ((pixels > 0) & (pixels < (1920, 1080))).all():
                    pixels = pixels + rng.normal(0, sigma_px, (4, 2))
                    markers.append(
                        Marker(marker_id, pixels, max(sigma_px, 0.001) ** 2 * np.eye(8), offset_ns)
                    )
            frame = Markers(stamp_ns, tuple(markers), 1920, 1080)
            messages.append(Message("/markers", stamp_ns, stamp_ns, frame, camera))
    return messages


def errors_of(found: BodyCalibration, sides: Sequence[float] = (1.0,) * 4) -> Array:
    """Return the errors (4, 7) of turns, centres, and logarithms of sides."""
    rows = []
    for marker, true in zip(found.markers, TRUE.markers, strict=True):
        pose, own = pose_from_rpy(true.xyz_m, true.rpy_rad), pose_from_rpy(marker.xyz_m, marker.rpy_rad)
        turn = rotation_vector(own[:3, :3] @ pose[:3, :3].T)
        rows.append([*turn, *(own - pose)[:3, 3], np.log(marker.length_m / 0.1 / sides[true.id])])
    return np.array(rows)


def test_exact_corners_of_a_moving_body_give_its_poses(cameras: dict[str, JointModel]) -> None:
    found = calibrate_body(cameras, RIG, "drone", carry(cameras, 0.0))
    assert np.abs(errors_of(found)).max() < 2e-6
    assert found.linked_frames > 10
    assert not found.remarks
    rig = found.apply(RIG)
    assert rig.markers[2].xyz_m == pytest.approx(TRUE.markers[2].xyz_m, abs=1e-5)
    assert rig.bodies[0].scale_sigma == pytest.approx(found.scale_sigma, rel=0.1)


def test_first_marker_keeps_its_pose_in_the_rig(cameras: dict[str, JointModel]) -> None:
    base = (0.0, 0.1, 0.3), (0.0, 0.0, 1.0)
    rig = replace(RIG, markers=(RigMarker(0, 0.1, "drone", None, None, *base), *RIG.markers[1:]))
    found = calibrate_body(cameras, rig, "drone", carry(cameras, 0.0, count=20))
    expected = pose_from_rpy(*base) @ pose_from_rpy(TRUE.markers[1].xyz_m, TRUE.markers[1].rpy_rad)
    assert found.markers[0].xyz_m == pytest.approx(base[0])
    assert found.markers[1].xyz_m == pytest.approx(tuple(expected[:3, 3]), abs=1e-5)


def test_wrong_side_in_the_rig_scales_no_body(cameras: dict[str, JointModel]) -> None:
    """One camera has the size of the body by the other prints."""
    sides = (1.0, 1.03, 1.0, 1.0)
    found = calibrate_body({"c0": cameras["c0"]}, RIG, "drone", carry(cameras, sides=sides))
    assert np.abs(errors_of(found, sides)[:, 6]).max() < 0.001
    assert found.scale_sigma == pytest.approx(0.002, rel=0.2)


def test_speed_scales_no_body(cameras: dict[str, JointModel]) -> None:
    """One camera has the size of the body by its prints: a smaller body, which moves less, is no better."""
    found = calibrate_body({"c0": cameras["c0"]}, RIG, "drone", carry(cameras, count=200, speed_m_s=1.0))
    assert abs(errors_of(found)[:, 6].mean()) < 0.25 * found.scale_sigma


def test_errors_of_a_body_agree_with_their_covariance(cameras: dict[str, JointModel]) -> None:
    shares = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        sides = np.exp(rng.normal(0, 0.002) + rng.normal(0, 0.001, 4)).tolist()
        found = calibrate_body(cameras, RIG, "drone", carry(cameras, 0.05, seed, sides))
        errors = errors_of(found, sides).ravel()[6:]
        covariance = found.covariance[6:, 6:]
        assert np.abs(errors / np.sqrt(covariance.diagonal())).max() < 4.0
        shares.append(errors @ np.linalg.solve(covariance, errors) / len(errors))
    assert 0.7 < np.mean(shares) < 1.3


MIRRORED = replace(
    TRUE,
    markers=tuple(
        replace(m, xyz_m=(m.xyz_m[0], -m.xyz_m[1], m.xyz_m[2])) if m.xyz_m else m for m in TRUE.markers
    ),
)
MOVED = replace(TRUE, markers=(*TRUE.markers[:3], replace(TRUE.markers[3], xyz_m=(-0.12, 0.1, 0.04))))


@pytest.mark.parametrize(
    ("rig", "options", "text", "ids"),
    [
        (RIG, {"groups": ((0, 1), (2, 3))}, "markers 0, 1 and 2, 3 of drone are never seen together", (0, 1)),
        (RIG, {"groups": (*[(0, 1, 2)] * 29, ALL)}, r"marker 3 of drone is in \d frames", (0, 1, 2)),
        (RIG, {"loose_m": 0.004}, r"marker 2 of drone contradicts the others in \d+ of \d+ frames", ALL),
        (MIRRORED, {}, "mirror image: y has the other sign", ALL),
        (MOVED, {}, "marker 3 of drone is 20 mm and 0 degrees away from its pose in the rig", ALL),
        (RIG, {"sides": (1.0, 1.03, 1.0, 1.0)}, "marker 1 of drone has a side of 103.0 mm", ALL),
        (RIG, {"sides": (1.03,) * 4}, "printed 3.0 % larger than length_m", ALL),
    ],
)
def test_contradiction_is_named(
    cameras: dict[str, JointModel],
    rig: Rig,
    options: dict[str, object],
    text: str,
    ids: tuple[int, ...],
) -> None:
    found = calibrate_body(cameras, rig, "drone", carry(cameras, **options))  # type: ignore[arg-type]
    (remark,) = found.remarks
    assert re.search(text, remark), remark
    assert tuple(marker.id for marker in found.markers) == ids


@pytest.mark.parametrize(
    ("robot", "ids", "text"),
    [
        ("ada", ALL, "ada: is no body of the rig, which has drone"),
        ("drone", (), "no frame shows its markers 0, 1, 2, 3"),
        ("drone", (0,), "its first marker 0 has no partner: marker 0 of drone is in 0 frames"),
    ],
)
def test_body_without_frames_is_an_error(
    cameras: dict[str, JointModel], robot: str, ids: tuple[int, ...], text: str
) -> None:
    with pytest.raises(IpsysError, match=text):
        calibrate_body(cameras, RIG, robot, carry(cameras, groups=(ids,), count=10))
