"""The estimated tilt of a camera, compared with known tilts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.app.report.camera_poses import advise
from ipsys_log.messages import CameraPoint, CameraPoints, Interval, Measurement
from ipsys_log.statistics.alignment import LEVEL_M, Alignment, align_camera
from ipsys_log.statistics.stationary import StationaryMarker, find_stationary
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.markers import camera_point, marker_corners
from ipsys_log.vision.poses import look_down, pose_facing_up, rotation, transform
from tests.ladder import follow

Array = NDArray[np.float64]

ORIGIN_M = np.array([2.4, 1.0, 2.1])
# Points under the camera, up to the edges of its image.
PLACES_M = np.array([(0.6, 0.3), (4.2, 0.3), (4.2, 1.7), (0.6, 1.7), (2.0, 1.1), (3.1, 0.6)])


def hang(tilt_deg: float, towards_deg: float) -> Array:
    """Return ``camera_from_world`` of a camera turned about an axis of its own image."""
    towards = math.radians(towards_deg)
    return look_down(ORIGIN_M, math.radians(tilt_deg) * np.array([math.cos(towards), math.sin(towards), 0.0]))


def lay(
    camera_from_world: Array, noise_m: float = 0.0, heights_m: Sequence[float] = (), seed: int = 0
) -> list[StationaryMarker]:
    """Return stationary markers at :data:`PLACES_M`. The supports under the markers are unknown."""
    rng = np.random.default_rng(seed)
    heights = np.zeros(len(PLACES_M))
    heights[: len(heights_m)] = heights_m
    points_m = transform(camera_from_world, np.column_stack([PLACES_M, heights]))
    # Most of the noise of a camera point is along the view.
    points_m *= 1 + noise_m / points_m[:, 2:] * rng.normal(size=(len(points_m), 1))
    return [StationaryMarker(n, point_m, np.zeros((3, 3))) for n, point_m in enumerate(points_m)]


def degrees(angle_rad: float | None) -> float:
    assert angle_rad is not None
    return math.degrees(angle_rad)


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0, 5.0])
@pytest.mark.parametrize("towards_deg", [0, 45, 100, 200, 290])
def test_known_tilt_is_estimated_and_the_advice_corrects_it(tilt_deg: float, towards_deg: float) -> None:
    camera = hang(tilt_deg, towards_deg)
    found = align_camera("red", lay(camera, 0.003))
    assert degrees(found.tilt_rad) == pytest.approx(tilt_deg, abs=0.2)
    assert found.down is not None
    # Compare the direction of the plumb line, not only its angle.
    assert math.degrees(math.acos(min(1.0, float(found.down @ -camera[:3, 2])))) < 0.2
    assert degrees(found.sigma_rad) < 0.2
    assert found.spread_m is not None
    assert found.remaining_m is not None
    assert found.remaining_m < 0.02
    if tilt_deg == 0:
        assert found.level
        assert advise(found).startswith("nothing: the camera is level, its spread is under 5 cm")
        return
    assert found.level == (found.spread_m < LEVEL_M)
    if tilt_deg == 5:
        assert not found.level
    if not found.level:
        after = align_camera("red", lay(follow(advise(found), camera), 0.003, seed=1))
        assert after.level
        assert degrees(after.tilt_rad) < 0.2


@pytest.mark.parametrize(
    ("axis", "says"),
    [
        # A rotation about the axis to the right of the image turns the view towards the top.
        ((1, 0), "3.0 degrees towards the bottom of its image (11 cm on the floor)"),
        ((-1, 0), "3.0 degrees towards the top of its image (11 cm on the floor)"),
        ((0, 1), "3.0 degrees towards the left of its image (11 cm on the floor)"),
        ((0, -1), "3.0 degrees towards the right of its image (11 cm on the floor)"),
    ],
)
def test_advice_names_the_direction_of_the_turn(axis: tuple[float, float], says: str) -> None:
    camera_turned = rotation(np.radians(3.0) * np.array([*axis, 0.0]))
    points_m = transform(look_down(ORIGIN_M), np.column_stack([PLACES_M, np.zeros(len(PLACES_M))]))
    # The camera axes are turned, so the points turn the other way.
    found = align_camera(
        "red", [StationaryMarker(n, p, np.zeros((3, 3))) for n, p in enumerate(points_m @ camera_turned)]
    )
    assert advise(found) == f"turn the camera {says}"


def by_eq_3(camera_from_world: Array) -> list[StationaryMarker]:
    lying = []
    for n, (x_m, y_m) in enumerate(PLACES_M):
        corners_m = transform(camera_from_world @ pose_facing_up(x_m, y_m, 0.0, 0.3 * n), marker_corners(0.2))
        lying.append(
            StationaryMarker(n, camera_point(corners_m[:, :2] / corners_m[:, 2:], 0.2), np.zeros((3, 3)))
        )
    return lying


@pytest.mark.parametrize("towards_deg", [0, 70])
def test_eq_3_overstates_a_tilt_by_half(towards_deg: float) -> None:
    """Test the reason to use camera points of the marker pose."""
    camera = hang(1.0, towards_deg)
    assert degrees(align_camera("red", by_eq_3(camera)).tilt_rad) == pytest.approx(1.5, abs=0.05)
    assert degrees(align_camera("red", lay(camera)).tilt_rad) == pytest.approx(1.0, abs=1e-6)


def test_a_marker_on_a_box_is_named_and_left_out() -> None:
    for raised in range(5):
        heights_m = [0.05 if n == raised else 0.0 for n in range(6)]
        found = align_camera("red", lay(hang(2.0, 30), 0.002, heights_m))
        ((lying, above_m),) = found.raised_markers
        assert lying.marker_id == raised
        assert above_m == pytest.approx(0.05, abs=0.01)
        assert degrees(found.tilt_rad) == pytest.approx(2.0, abs=0.2)
    flat = align_camera("red", lay(hang(2.0, 30), 0.002))
    assert flat.raised_markers == ()


def test_raised_marker_of_four_cannot_be_identified() -> None:
    found = align_camera("red", lay(hang(0.0, 0), 0.001, [0.08])[:4])
    assert found.raised_markers == ()
    assert found.uneven_m == pytest.approx(0.04, abs=0.005)
    assert align_camera("red", lay(hang(3.0, 0), 0.001)[:4]).uneven_m is None


def test_measured_height_is_subtracted() -> None:
    camera = hang(4.0, 130)
    lying = lay(camera, 0.0, [0.2, 0.0, 0.1, 0.15])
    known = [
        StationaryMarker(one.marker_id, one.point_m, one.covariance_m2, height_m)
        for one, height_m in zip(lying, [0.2, 0.0, 0.1, 0.15, 0.0, 0.0], strict=True)
    ]
    found = align_camera("red", known)
    assert degrees(found.tilt_rad) == pytest.approx(4.0, abs=1e-3)
    assert found.remaining_m == pytest.approx(0.0, abs=1e-4)
    assert found.height_m == pytest.approx(2.1)
    assert found.raised_markers == ()


def test_one_and_two_markers_and_markers_on_a_line() -> None:
    camera = hang(5.0, 90)  # turned to the left or right of the image
    lying = lay(camera)
    assert "none is stationary" in advise(align_camera("red", []))
    one = align_camera("red", lying[:1])
    assert (one.spread_m, one.level, one.tilt_rad) == (None, None, None)
    assert "put three or more markers" in advise(one)
    two = align_camera("red", lying[:2])
    assert two.axes == 1
    assert degrees(two.tilt_rad) == pytest.approx(5.0, abs=0.1)
    assert "only along the line of its markers" in advise(two)
    across = align_camera("red", lying[1:3])
    assert degrees(across.tilt_rad) < 0.5  # the markers give no information across the line
    assert across.spread_m is not None
    assert across.spread_m < LEVEL_M
    assert across.level is None  # not green: the camera is tilted by 5 degrees
    assert advise(across).startswith("put a marker beside the line of its markers")
    assert two.level is False
    line = [
        StationaryMarker(
            n, lying[0].point_m + n * (lying[1].point_m - lying[0].point_m) / 5, np.zeros((3, 3))
        )
        for n in range(6)
    ]
    assert align_camera("red", line).axes == 1
    near = [lying[0], StationaryMarker(1, lying[0].point_m + np.array([0.05, 0, 0]), np.zeros((3, 3)))]
    assert align_camera("red", near).axes == 0
    assert align_camera("red", near).level is None  # not green, whatever the spread
    assert "further apart" in advise(align_camera("red", near))


def test_spread_without_a_tilt_is_reported() -> None:
    """Bad intrinsics make the floor look curved."""
    lying = lay(hang(0.0, 0))
    bowl = [
        StationaryMarker(
            one.marker_id,
            one.point_m * (1 + 0.05 * float(one.point_m[0] ** 2 + one.point_m[1] ** 2) / 4),
            one.covariance_m2,
        )
        for one in lying
    ]
    found = align_camera("red", bowl)
    assert found.level is False
    assert "repeat the intrinsic calibration" in advise(found)


def test_the_uncertainty_is_that_of_the_scatter() -> None:
    misses, sigmas_deg = [], []
    for seed in range(200):
        found: Alignment = align_camera("red", lay(hang(3.0, 20), 0.01, seed=seed))
        assert found.down is not None
        misses.append(found.down + hang(3.0, 20)[:3, 2])
        sigmas_deg.append(degrees(found.sigma_rad))
    # Compare the variances in the direction with the largest uncertainty.
    off_rad = np.sqrt(np.mean(np.square(misses), axis=0)).max()
    assert 0.8 < np.degrees(off_rad) / np.sqrt(np.mean(np.square(sigmas_deg))) < 1.2
    # The rate of false outliers is not above chance.
    named = [
        len(align_camera("red", lay(hang(3.0, 20), 0.01, seed=seed)).raised_markers) for seed in range(200)
    ]
    assert np.mean(np.array(named) > 0) < 0.1


def carried(places_m: Sequence[Array]) -> Iterator[CameraPoints]:
    """Return frames of a marker that stays one second at each point and is then carried to the next."""
    time_ns = 0
    for here_m, next_m in zip(places_m, [*places_m[1:], None], strict=True):
        for _ in range(30):
            yield CameraPoints(time_ns, (CameraPoint(7, *here_m.tolist()),))
            time_ns += NS_PER_S // 30
        for part in np.linspace(0.02, 0.98, 50) if next_m is not None else ():
            at_m = (1 - part) * here_m + part * next_m - [0, 0, 0.6 * part * (1 - part)]
            yield CameraPoints(time_ns, (CameraPoint(7, *at_m.tolist()),))
            time_ns += NS_PER_S // 30


def test_one_marker_can_visit_the_points_in_turn() -> None:
    camera = hang(4.0, 200)
    places_m = [one.point_m for one in lay(camera)]
    lying = find_stationary(carried(places_m))
    assert len(lying) == len(places_m)
    assert np.abs(np.array([one.point_m for one in lying]) - places_m).max() < 1e-9
    assert {one.marker_id for one in lying} == {7}
    assert degrees(align_camera("red", lying).tilt_rad) == pytest.approx(4.0, abs=0.01)


def test_one_frame_per_point_is_enough_with_pauses() -> None:
    places_m = [one.point_m for one in lay(hang(4.0, 200))]
    frames = [CameraPoints(n * 3 * NS_PER_S, (CameraPoint(7, *p.tolist()),)) for n, p in enumerate(places_m)]
    assert len(find_stationary(frames)) == len(places_m)
    # A moving robot has no stationary interval.
    passing = [CameraPoints(n * NS_PER_S // 10, (CameraPoint(7, 0.1 * n, 0.0, 2.0),)) for n in range(20)]
    assert find_stationary(passing) == []


def test_a_measured_height_belongs_to_its_time() -> None:
    frames = [CameraPoints(n * 3 * NS_PER_S, (CameraPoint(7, 0.3 * n, 0.0, 2.0),)) for n in range(3)]
    still = Interval(3 * NS_PER_S, 3 * NS_PER_S)
    other = Measurement(0, "b", marker_id=8, height_m=0.4, still=still)
    measured = Measurement(3 * NS_PER_S, "a", marker_id=7, height_m=0.15, still=still)
    assert [one.height_m for one in find_stationary(frames, [other, measured])] == [0.0, 0.15, 0.0]
