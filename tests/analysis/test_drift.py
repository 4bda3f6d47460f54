"""Motion of a camera from reference markers, against a camera that truly moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Floor
from ipsys_log.statistics.drift import DriftBaseline, MeanCorners, Motion, build_baseline, estimate_motion
from ipsys_log.statistics.floor_cameras import floor_grid, shift_floor_map
from ipsys_log.vision.lenses import intersect_height, project, undistort
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import PosedCamera, make_pose, pose_facing_up, rotation, transform

Array = NDArray[np.float64]

LENGTH_M = 0.15
FLOOR = Floor(4.88, 4.88)
ONE, TWO = ((1.2, 2.2),), ((1.2, 2.2), (3.6, 2.6))
THREE, LINE = ((1.0, 2.0), (3.8, 2.0), (2.4, 3.1)), ((1.0, 2.4), (2.4, 2.42), (3.8, 2.4))
FOUR = (*THREE, (2.0, 1.9))


def camera(seed: int = 1) -> PosedCamera:
    mounted = mount_cameras(LabSettings(seed=seed))[1]
    return PosedCamera.at_pose(mounted.name, mounted.lens, mounted.camera_from_world)


def corners(
    own: PosedCamera, places: Sequence[tuple[float, float]], rng: np.random.Generator | None = None
) -> dict[int, MeanCorners]:
    """Return the corners of markers on the floor, with slow changes of light if there is a generator."""
    means = {}
    for number, (x_m, y_m) in enumerate(places):
        placed_m = transform(pose_facing_up(x_m, y_m, 0.0, 0.7 * number), marker_corners(LENGTH_M))
        px = project(own.transform(placed_m), own.lens)
        if rng is not None:
            px = px + rng.normal(0, 0.05, 2) + rng.normal(0, 0.02, (4, 2))
        means[90 + number] = MeanCorners(px, 50)
    return means


def baseline(own: PosedCamera, means: Mapping[int, MeanCorners]) -> DriftBaseline:
    return build_baseline(own, floor_grid(own, FLOOR), means, dict.fromkeys(means, LENGTH_M))


def estimate(
    places: Sequence[tuple[float, float]], motion: Array, rng: np.random.Generator | None = None
) -> Motion:
    own = camera()
    found = estimate_motion(baseline(own, corners(own, places, rng)), corners(own.move(motion), places, rng))
    assert found is not None
    return found


def true_shift_m(motion: Array) -> float:
    """Return the mean shift of the floor map by pixels: moved camera, old lens and pose, floor."""
    own = camera()
    points_m = floor_grid(own, FLOOR)
    uv = undistort(project(own.move(motion).transform(points_m), own.lens), own.lens)
    rays = np.column_stack([uv, np.ones(len(uv))]) @ own.camera_from_world
    located_m = intersect_height(own.origin_m, rays, np.zeros(len(rays)))
    return float(np.linalg.norm(located_m - points_m, axis=1).mean())


small = st.floats(-1, 1).map(lambda value: round(value, 3))


@given(st.tuples(*[small] * 6))
@settings(max_examples=15)
def test_shift_of_floor_map_equals_pixels_of_moved_camera(parts: tuple[float, ...]) -> None:
    motion = np.array(parts) * [0.01, 0.01, 0.01, 0.02, 0.02, 0.02]
    own = camera()
    shift_m = np.linalg.norm(shift_floor_map(own, floor_grid(own, FLOOR), motion), axis=1).mean()
    assert shift_m == pytest.approx(true_shift_m(motion), abs=1e-7)


@given(st.tuples(*[small] * 6))
@settings(max_examples=8)
def test_exact_corners_give_the_shift_of_the_floor_map(parts: tuple[float, ...]) -> None:
    motion = np.array(parts) * [0.005, 0.005, 0.005, 0.01, 0.01, 0.01]
    truth_m = true_shift_m(motion)
    found = estimate(THREE, motion)
    assert found.mean_shift_m == pytest.approx(truth_m, abs=0.0002 + 0.05 * truth_m)


@pytest.mark.parametrize("places", [ONE, TWO, THREE])
def test_still_camera_never_counts_as_moved(places: Sequence[tuple[float, float]]) -> None:
    for seed in range(15):
        found = estimate(places, np.zeros(6), np.random.default_rng(seed))
        assert not found.is_moved
        assert found.mean_shift_m < 0.0006


@pytest.mark.parametrize(
    ("places", "shift_m", "sigma_m"), [(ONE, 0.003, 0.0012), (TWO, 0.002, 0.0004), (THREE, 0.002, 0.0004)]
)
@pytest.mark.parametrize("axis", [0, 1, 3, 4])
def test_small_motion_is_found(
    places: Sequence[tuple[float, float]], shift_m: float, sigma_m: float, axis: int
) -> None:
    motion = np.eye(6)[axis]
    motion *= shift_m / true_shift_m(1e-3 * motion) * 1e-3
    found = estimate(places, motion, np.random.default_rng(axis))
    assert found.is_moved
    assert abs(found.mean_shift_m - shift_m) < 3 * found.sigma_m
    assert found.sigma_m < sigma_m


def test_errors_have_the_stated_size() -> None:
    motion = np.array([0.002, -0.001, 0.0, 0.001, 0.0, 0.0])
    truth_m = true_shift_m(motion)
    found = [estimate(THREE, motion, np.random.default_rng(seed)) for seed in range(25)]
    scores = np.array([(one.mean_shift_m - truth_m) / one.sigma_m for one in found])
    assert (np.abs(scores) < 1.96).mean() >= 0.9


def test_turn_and_shift_are_known_with_three_markers() -> None:
    motion = np.array([0.010, 0.0145, 0.001, 0.004, -0.003, 0.002])
    found = estimate(THREE, motion, np.random.default_rng(4))
    assert found.why_no_split is None
    sigmas = np.sqrt(found.covariance.diagonal())
    assert (np.abs(found.motion - motion) < 3.5 * sigmas).all()
    assert sigmas[:3].max() < 0.002


@pytest.mark.parametrize(
    ("places", "reason"), [(ONE, "1 reference marker;"), (TWO, "2 reference"), (LINE, "line")]
)
def test_few_markers_do_not_separate_turn_and_shift(
    places: Sequence[tuple[float, float]], reason: str
) -> None:
    found = estimate(places, np.array([0.002, 0, 0, 0, 0, 0]))
    assert found.why_no_split is not None
    assert "cannot be separated" in found.why_no_split
    assert reason in found.why_no_split


def test_marker_that_moved_is_named_and_camera_is_not() -> None:
    own, rng = camera(), np.random.default_rng(2)
    before, after = corners(own, FOUR, rng), corners(own, FOUR, rng)
    moved = corners(own, [(1.0, 2.0), (3.81, 2.0)])
    found = estimate_motion(baseline(own, before), {**after, 91: moved[91]})
    assert found is not None
    assert (found.inconsistent, found.is_moved, found.is_unclear) == ((91,), False, False)


def test_two_markers_that_disagree_are_unclear() -> None:
    own = camera()
    moved = corners(own, [(1.2, 2.2), (3.62, 2.6)])
    found = estimate_motion(baseline(own, corners(own, TWO)), moved)
    assert found is not None
    assert found.is_unclear


def test_marker_on_a_wall_shows_a_motion() -> None:
    own, motion = camera(), np.array([0.001, 0.0008, 0.0, 0.0, 0.0, 0.0])
    steep = rotation(np.array([0.0, 0.0, 0.4])) @ rotation(np.array([1.2, 0.0, 0.0]))
    placed_m = transform(make_pose(steep, np.array([2.4, 2.9, 0.1])), marker_corners(LENGTH_M))
    seen = [
        {90: MeanCorners(project(one.transform(placed_m), one.lens), 50)} for one in (own, own.move(motion))
    ]
    found = estimate_motion(baseline(own, seen[0]), seen[1])
    assert found is not None
    assert found.is_moved
    assert found.mean_shift_m == pytest.approx(true_shift_m(motion), rel=0.3)
