"""The advice on a calibration that could be better."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting
from ipsys_log.calibration.board_search import SearchResult
from ipsys_log.calibration.calibrate import CalibrationResult, calibrate
from ipsys_log.calibration.lens_models import LENS_MODELS
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
