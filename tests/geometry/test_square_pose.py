"""Estimated poses of squares, compared with the poses that gave the corners."""

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ipsys_log.messages import CameraCalibration
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import camera_point, marker_corners, pixel_slopes, whiten
from ipsys_log.vision.square_pose import SquarePoses, fit_squares, is_convex, reprojection_px, solve_squares
from tests.geometry.squares import (
    CENTRE,
    EDGE,
    FISHEYE,
    LENGTH_M,
    LENSES,
    MIDWAY,
    Array,
    corners_px,
    random_poses,
    turned,
)


def fit(
    seen_px: Array, lens: CameraCalibration, covariance_px2: Array, length_m: float = LENGTH_M
) -> SquarePoses:
    """Return markers (n, 4, 2) in px, all with the same noise, one frame after the other."""
    uv = undistort(seen_px.reshape(-1, 2), lens)
    slopes = np.zeros((len(seen_px), 4, 2, 4, 2))
    corner = np.arange(4)
    slopes[:, corner, :, corner, :] = pixel_slopes(uv, lens).reshape(-1, 4, 2, 2).swapaxes(0, 1)
    whitening = whiten(np.broadcast_to(covariance_px2, (len(seen_px), 8, 8))) @ slopes.reshape(-1, 8, 8)
    return fit_squares(uv.reshape(-1, 4, 2), whitening, np.full(len(seen_px), length_m))


def tilts_deg(poses: SquarePoses, axes: Array) -> Array:
    """Return the angles between the two estimated normals and the true normals, (n, 2)."""
    cosines = np.einsum("nki,ni->nk", poses.rotations[..., 2], axes[:, :, 2])
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosines, -1, 1))))


@pytest.mark.parametrize("model", LENSES)
def test_exact_corners_give_the_exact_pose(model: str) -> None:
    lens = LENSES[model]
    axes, centres_m, seen_px = random_poses(100, np.random.default_rng(0), lens)
    found = fit(seen_px, lens, 0.0009 * np.eye(8))
    # The last steps are small if both poses are nearly equal.
    np.testing.assert_allclose(found.centres_m[:, 0], centres_m, atol=3e-6)
    assert np.median(np.abs(found.centres_m[:, 0] - centres_m)) < 1e-11
    np.testing.assert_allclose(found.rotations[:, 0], axes, atol=1e-4)
    misses_px = reprojection_px(found.rotations, found.centres_m, np.full(100, LENGTH_M), seen_px, lens)
    assert misses_px[:, 0].max() < 1e-3


@pytest.mark.parametrize("heading_rad", [0.0, np.pi / 2, np.pi, -np.pi / 2, 0.3])
@pytest.mark.parametrize("centre_m", [(0.0, 0.0, 2.0), (1.0, 0.0, 2.0), EDGE])
def test_a_marker_that_faces_the_camera(heading_rad: float, centre_m: tuple[float, float, float]) -> None:
    """After a half turn about an axis in the plane, OpenCV's IPPE gives no numbers or wrong ones."""
    axes = turned(heading_rad)
    uv = (marker_corners(LENGTH_M) @ axes.T + centre_m)[:, :2] / centre_m[2]
    found = fit_squares(uv[None], 5000 * np.eye(8)[None], np.array([LENGTH_M]))
    np.testing.assert_allclose(found.centres_m[0, 0], centre_m, atol=1e-6)
    np.testing.assert_allclose(found.rotations[0, 0], axes, atol=1e-4)


def test_the_formula_is_opencvs() -> None:
    _, _, seen_px = random_poses(100, np.random.default_rng(1), FISHEYE)
    seen_px += np.random.default_rng(2).normal(0, 0.5, seen_px.shape)
    uv = undistort(seen_px.reshape(-1, 2), FISHEYE).reshape(-1, 4, 2)
    rotations, centres_m = solve_squares(uv, np.full(100, LENGTH_M))
    square, flag = marker_corners(LENGTH_M), cv2.SOLVEPNP_IPPE_SQUARE
    for n in range(100):
        _, vectors, shifts, _ = cv2.solvePnPGeneric(square, uv[n], np.eye(3), None, flags=flag)
        theirs = sorted(Rotation.from_rotvec(np.ravel(v)).as_matrix().ravel().tolist() for v in vectors)
        np.testing.assert_allclose(sorted(rotations[n].reshape(2, 9).tolist()), theirs, atol=1e-5)
        # OpenCV fits the centre to all corners; the formula takes the intersection of the diagonals.
        np.testing.assert_allclose(centres_m[n, 0], np.ravel(shifts[0]), atol=0.03)


@pytest.mark.parametrize("place_m", [CENTRE, MIDWAY, EDGE])
def test_the_refined_pose_is_that_of_least_squares_in_pixels(place_m: tuple[float, float, float]) -> None:
    """Compute the pose with the lens itself and the whole covariance, by SciPy."""
    rng = np.random.default_rng(3)
    root = rng.normal(0, 0.05, (8, 8))
    axes = turned(0.7, 6.0, 1.0)
    seen_px = corners_px(FISHEYE, axes, np.array(place_m)) + (root @ rng.normal(size=8)).reshape(4, 2)
    found = fit(seen_px[None], FISHEYE, root @ root.T)
    whitening = np.linalg.inv(root)

    def misses(pose: Array) -> Array:
        again_px = corners_px(FISHEYE, Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:])
        return np.asarray(whitening @ (again_px - seen_px).ravel())

    # At the image centre, the second solution slowly converges to the first one.
    for k in range(1 if place_m is CENTRE else 2):
        start = np.concatenate(
            [Rotation.from_matrix(found.rotations[0, k]).as_rotvec(), found.centres_m[0, k]]
        )
        best = least_squares(misses, start, x_scale="jac", xtol=1e-12, ftol=1e-12)
        # The error for a hundredth of the noise; the lens is not exactly linear over the larger error.
        assert found.chi2[0, k] <= 2 * best.cost * 1.05 + 1e-3
        if k == 0:
            sigma_m = np.sqrt(np.diag(found.covariances_m2[0]))
            assert (np.abs(best.x[3:] - found.centres_m[0, k]) < 0.02 * sigma_m).all()


@pytest.mark.parametrize("place_m", [CENTRE, MIDWAY])
def test_the_depth_has_no_bias(place_m: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(4)
    exact_px = corners_px(FISHEYE, turned(0.4), np.array(place_m))
    found = fit(exact_px + rng.normal(0, 0.03, (1000, 4, 2)), FISHEYE, 0.0009 * np.eye(8))
    off_m = found.centres_m[:, 0, 2] - place_m[2]
    assert abs(off_m.mean()) < 0.0005 / 5
    # 0.4 mm at the image centre, 0.65 mm half-way out
    assert off_m.std() < 0.0008


@pytest.mark.parametrize("place_m", [CENTRE, MIDWAY, EDGE])
@pytest.mark.parametrize("rank", [8, 6])
def test_the_covariance_is_that_of_the_scatter(place_m: tuple[float, float, float], rank: int) -> None:
    rng = np.random.default_rng(5)
    axes, centre_m = turned(-2.0, 3.0, 0.5), np.array(place_m)
    exact_px = corners_px(FISHEYE, axes, centre_m)
    root = rng.normal(0, 0.02, (8, 8)) if rank == 8 else 0.03 * pose_slopes(axes, centre_m)
    noise_px = rng.normal(size=(3000, root.shape[1])) @ root.T
    covariance = (root @ root.T).astype(np.float32).astype(np.float64)
    found = fit(exact_px + noise_px.reshape(-1, 4, 2), FISHEYE, covariance)
    scatter = np.cov(found.centres_m[:, 0].T)
    whitener = np.linalg.inv(np.linalg.cholesky(scatter))
    ratios = np.linalg.eigvalsh(whitener @ found.covariances_m2.mean(axis=0) @ whitener.T)
    assert 0.85 < ratios.min() < ratios.max() < 1.15


def pose_slopes(axes: Array, centre_m: Array) -> Array:
    """Return an orthonormal basis of the corner shifts by the six motions of a marker, (8, 6)."""
    moved = []
    for step in 1e-5 * np.eye(6):
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ axes
        moved.append((corners_px(FISHEYE, turn, centre_m + step[3:])).ravel())
    base = corners_px(FISHEYE, axes, centre_m).ravel()
    return np.asarray(np.linalg.qr((np.stack(moved, axis=1) - base[:, None]) / 1e-5)[0])


def test_corners_of_a_fitted_pose_give_that_pose() -> None:
    """The two directions without noise do not decide the choice alone, and cause no error."""
    axes, centres_m, seen_px = random_poses(60, np.random.default_rng(6), FISHEYE)
    for n in range(60):
        basis = pose_slopes(axes[n], centres_m[n])
        covariance = (0.0009 * basis @ basis.T).astype(np.float32).astype(np.float64)
        found = fit(seen_px[n : n + 1], FISHEYE, covariance)
        np.testing.assert_allclose(found.centres_m[0, 0], centres_m[n], atol=1e-6)
        assert np.isfinite(found.covariances_m2).all()
        assert np.linalg.eigvalsh(found.covariances_m2[0]).max() < 0.003**2


def test_both_solutions_are_there() -> None:
    """The second pose mirrors the normal at the line of sight.

    The poses differ at the image edge, not at the centre.
    """
    axes, centre_m = turned(0.4, 3.0, 1.0), np.array(EDGE)
    found = fit(corners_px(FISHEYE, axes, centre_m)[None], FISHEYE, 0.0009 * np.eye(8))
    sight = centre_m / np.linalg.norm(centre_m)
    mirrored = 2 * (sight @ axes[:, 2]) * sight - axes[:, 2]
    right_deg, wrong_deg = tilts_deg(found, axes[None])[0]
    assert right_deg < 0.001
    assert wrong_deg > 60
    between = np.rad2deg(np.arccos(found.rotations[0, 1, :, 2] @ mirrored))
    assert between < 10
    assert found.chi2[0, 0] < 1e-6 < found.chi2[0, 1]


@pytest.mark.parametrize(
    ("length_m", "sigma_px", "most"),
    [(0.2, 0.03, 0.0), (0.2, 0.25, 0.006), (0.1, 0.03, 0.002), (0.1, 0.25, 0.01)],
)
def test_rate_of_wrong_pose_choices_is_bounded(length_m: float, sigma_px: float, most: float) -> None:
    """The corners alone or the tilt alone choose worse; docs/method.md has the figures."""
    rng = np.random.default_rng(7)
    axes, _, seen_px = random_poses(2000, rng, FISHEYE, length_m)
    seen_px += rng.normal(0, sigma_px, seen_px.shape)
    found = fit(seen_px, FISHEYE, sigma_px**2 * np.eye(8), length_m)
    tilts = tilts_deg(found, axes)
    assert (tilts[:, 0] > tilts[:, 1] + 0.5).mean() <= most


def test_mirrored_poses_of_tilted_markers_are_rare() -> None:
    """If all markers are expected to be level, 6 % of these get their mirrored pose, otherwise 1.2 %."""
    rng = np.random.default_rng(8)
    axes: list[Array] = []
    seen_px: list[Array] = []
    while len(axes) < 2000:
        centre_m = np.array([*rng.uniform(-1, 1, 2) * (1.5, 0.8), rng.uniform(1.9, 2.1)])
        axes.append(turned(rng.uniform(-3, 3), rng.uniform(15, 30), rng.uniform(0, 2 * np.pi)))
        seen_px.append(corners_px(FISHEYE, axes[-1], centre_m, 0.1))
    noisy_px = np.array(seen_px) + rng.normal(0, 0.1, (2000, 4, 2))
    tilts = tilts_deg(fit(noisy_px, FISHEYE, 0.01 * np.eye(8), 0.1), np.array(axes))
    assert (tilts[:, 0] > tilts[:, 1] + 0.5).mean() < 0.02


def test_corners_outweigh_the_tilt_where_they_are_sure() -> None:
    """A tilted marker: its mirrored solution faces the camera much better."""
    axes, centre_m = turned(0.4, 35.0, np.pi / 2), np.array([0.6, 0.1, 2.0])
    found = fit(corners_px(FISHEYE, axes, centre_m)[None], FISHEYE, 0.0009 * np.eye(8))
    right_deg, wrong_deg = tilts_deg(found, axes[None])[0]
    assert right_deg < 0.001
    assert wrong_deg > 20
    # With the tilt as the only criterion, the other pose would win.
    assert found.rotations[0, 1, 2, 2] < found.rotations[0, 0, 2, 2]


@pytest.mark.parametrize(
    ("place_m", "least_m", "most_m"), [(CENTRE, 0.002, 0.006), (MIDWAY, 0.05, 0.08), (EDGE, 0.12, 0.25)]
)
def test_error_of_a_5_degree_tilt_is_bounded(
    place_m: tuple[float, float, float], least_m: float, most_m: float
) -> None:
    """Eq. (3) takes the foreshortened marker for a more distant one; docs/method.md has the figures."""
    off_m = []
    for about_rad in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        seen_px = corners_px(FISHEYE, turned(0.3, 5.0, about_rad), np.array(place_m))
        by_perimeter_m = camera_point(undistort(seen_px, FISHEYE), LENGTH_M)
        off_m.append(float(np.linalg.norm(by_perimeter_m - place_m)))
        by_pose_m = fit(seen_px[None], FISHEYE, 0.0009 * np.eye(8)).centres_m[0, 0]
        np.testing.assert_allclose(by_pose_m, place_m, atol=1e-6)
    assert least_m < max(off_m) < most_m


def test_corners_that_go_around() -> None:
    square = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    assert is_convex(square)
    assert not is_convex(square[::-1])  # from behind
    assert not is_convex(square[[0, 2, 1, 3]])  # crossed
    assert not is_convex(np.zeros((4, 2)))
    assert not is_convex(np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.3, 0.0]]))
