"""The advice on a calibration that could be better."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting
from ipsys_log.calibration.board_search import SearchResult
from ipsys_log.calibration.calibrate import CalibrationResult, calibrate
from ipsys_log.calibration.lens_models import (
    LENS_MODELS,
    find_lens_model,
    project_points,
    project_with_slopes,
)
from ipsys_log.errors import IpsysError
from tests.calibration.boards_seen import SIZE_PX, TRUTH, grid_m, pixels_of, seen

BOARD = Board(6, 4, 0.03)


def sightings(
    places_m: list[tuple[float, float, float]],
    tilt_rad: float,
    noise_px: float = 0.1,
    blur_px: float = 0.8,
    seed: int = 0,
    name: str = "pinhole",
) -> SearchResult:
    """Return boards at these points, each with another tilt."""
    rng, found = np.random.default_rng(seed), []
    for n, place_m in enumerate(places_m):
        turn = Rotation.from_rotvec([tilt_rad * np.cos(n * 2.4), tilt_rad * np.sin(n * 2.4), 0]).as_matrix()
        pixels = pixels_of(name, TRUTH[name], grid_m() @ turn.T + place_m)
        pixels += rng.normal(0, noise_px, pixels.shape)
        found.append(BoardSighting(f"{n}.png", np.arange(24), pixels, blur_px, pixels[[0, 5, 23, 18]]))
    return SearchResult(len(found), SIZE_PX, tuple(found), ())


def everywhere(
    x: tuple[float, float] = (-0.13, 0.13), y: tuple[float, float] = (-0.1, 0.1)
) -> list[tuple[float, float, float]]:
    """Return twenty board poses all over the image, near and far."""
    return [
        (float(a), float(b), z)
        for n, a in enumerate(np.linspace(*x, 5))
        for m, b in enumerate(np.linspace(*y, 4))
        for z in [0.33 + 0.04 * ((n + m) % 2)]
    ]


def calibrated(looked: SearchResult) -> CalibrationResult:
    return calibrate("red", looked, BOARD, LENS_MODELS["pinhole"])


def test_good_images_give_no_advice() -> None:
    found = calibrated(sightings(everywhere(), 0.5))
    assert found.notes == ()
    assert found.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
    assert found.median_px == pytest.approx(0.1 * np.sqrt(2 * np.log(2)), rel=0.15)


def test_image_side_without_a_board_is_named() -> None:
    found = calibrated(sightings(everywhere(x=(-0.03, 0.13)), 0.5))
    assert "no board near the left edge of the image: move it there, too" in found.notes
    assert found.coverage.empty_sides == ("left",)


def test_a_board_that_was_hardly_tilted() -> None:
    notes = calibrated(sightings(everywhere(), 0.2)).notes
    assert any("tilted by 25 degrees or more in 0 pictures" in note for note in notes)


def test_untilted_board_gives_no_focal_length() -> None:
    with pytest.raises(IpsysError, match="tilt it to all sides"):
        calibrated(sightings([(x, 0.0, 0.5) for x in np.linspace(-0.03, 0.03, 10)], 0.0, noise_px=0.3))


@pytest.mark.parametrize("name", ["fisheye", "pinhole", "pinhole4"])
def test_parallel_boards_give_no_focal_length_at_any_distance(name: str) -> None:
    """Otherwise the focal length falls to a hundredth, with a wrong standard deviation."""
    looked = sightings(everywhere(), 0.0, name=name)
    with pytest.raises(IpsysError, match="tilt it to all sides"):
        calibrate("red", looked, BOARD, LENS_MODELS[name])


def test_slightly_tilted_boards_give_a_large_sigma() -> None:
    """A much shorter focal length fits better as long as the distortion is fixed at zero."""
    for seed in range(2):
        found = calibrated(sightings(everywhere(), 0.12, noise_px=0.05, seed=seed))
        assert abs(found.values[0] - 600) < min(4 * found.sigmas[0], 60)


def test_images_that_are_all_blurred_are_reported() -> None:
    notes = calibrated(sightings(everywhere(), 0.5, blur_px=3.0)).notes
    assert any("edges are 3.0 px wide in all pictures" in note for note in notes)


def test_corners_with_large_errors_are_reported() -> None:
    looked = sightings(everywhere(), 0.5, noise_px=1.0)
    assert any("px: check that the board is flat" in note for note in calibrated(looked).notes)


def through_fisheye() -> SearchResult:
    """Return boards all over the image of a fisheye, up to 85 degrees from its axis."""
    corners = seen("fisheye", np.random.default_rng(1)).pixels.reshape(-1, 24, 2)
    views = [
        BoardSighting(f"{n}.png", np.arange(24), p, 0.8, p[[0, 5, 23, 18]]) for n, p in enumerate(corners)
    ]
    return SearchResult(len(views), SIZE_PX, tuple(views), ())


def test_pinhole_on_a_fisheye_is_refused() -> None:
    with pytest.raises(
        IpsysError, match=r"error is .*use --lens fisheye, with an error of 0\.1\d px; or use"
    ):
        calibrate("red", through_fisheye(), BOARD, LENS_MODELS["pinhole4"])


# A second solution of the same images.
@pytest.mark.slow
def test_pinhole_on_a_fisheye_insisted_on_is_noted() -> None:
    result = calibrate("red", through_fisheye(), BOARD, LENS_MODELS["pinhole4"], force=True)
    assert result.rms_px > 2
    assert "written only because of --force: the RMS reprojection error is" in result.notes[0]


def test_too_few_images_name_the_missing_poses() -> None:
    looked = sightings([(-0.05, 0.0, 0.4), (0.05, 0.03, 0.4), (0.0, -0.03, 0.4)], 0.4)
    with pytest.raises(IpsysError, match=r"only 3 of 3 pictures can be used.*no board near the left, right"):
        calibrated(looked)


STILL = np.zeros(3)


def points(seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.6, 0.6, (50, 2)), rng.uniform(0.6, 2.0, 50)])


@pytest.mark.parametrize("name", list(LENS_MODELS))
def test_pixels_are_those_of_opencv(name: str) -> None:
    lens = np.array(TRUTH[name])
    k = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    expected, _ = project(points().reshape(-1, 1, 3), STILL, STILL, k, lens[4:])
    pixels = project_points(LENS_MODELS[name], lens, points())
    np.testing.assert_allclose(pixels, np.reshape(expected, (-1, 2)), atol=1e-9)


def test_a_fisheye_sees_what_is_beside_and_behind_it() -> None:
    beyond = points() * (1.0, 1.0, -0.3)
    pixels = project_points(LENS_MODELS["fisheye"], np.array(TRUTH["fisheye"]), beyond)
    np.testing.assert_allclose(pixels, pixels_of("fisheye", TRUTH["fisheye"], beyond), atol=1e-9)
    # Farther from the principal point than any point in front of the camera.
    middle = TRUTH["fisheye"][2:4]
    assert np.linalg.norm(pixels - middle, axis=1).min() > 185 * np.pi / 2 * 0.9


@pytest.mark.parametrize("name", list(LENS_MODELS))
def test_derivatives(name: str) -> None:
    model, lens, here = LENS_MODELS[name], np.array(TRUTH[name]), points(1)
    if name == "fisheye":
        here[:10, 2] *= -1
    _, by_point, by_lens = project_with_slopes(model, lens, here)
    step = 1e-6
    for n, axis in enumerate(np.eye(3) * step):
        ahead, behind = (project_points(model, lens, here + sign * axis) for sign in (1, -1))
        np.testing.assert_allclose(by_point[:, :, n], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-4)
    for n, axis in enumerate(np.eye(lens.size) * step):
        ahead, behind = (project_points(model, lens + sign * axis, here) for sign in (1, -1))
        np.testing.assert_allclose(by_lens[:, :, n], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-4)


def test_optical_axis_projects_to_the_principal_point() -> None:
    pixels, by_point, _ = project_with_slopes(
        LENS_MODELS["fisheye"], np.array(TRUTH["fisheye"]), np.array([[0.0, 0.0, 2.0]])
    )
    np.testing.assert_allclose(pixels[0], TRUTH["fisheye"][2:4])
    np.testing.assert_allclose(by_point[0, :, :2], np.eye(2) * 185.0 / 2.0, atol=1e-6)


def test_missing_calibration_is_refused() -> None:
    with pytest.raises(IpsysError, match="use one of fisheye, pinhole"):
        find_lens_model("omni")
