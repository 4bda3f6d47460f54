"""Images of two cameras in one folder are separated; those of one camera are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting
from ipsys_log.calibration.board_search import SearchResult
from ipsys_log.calibration.bundle_adjustment import Corners
from ipsys_log.calibration.calibrate import CalibrationResult, calibrate
from ipsys_log.calibration.lens_models import LENS_MODELS
from ipsys_log.calibration.solve import find_start
from ipsys_log.calibration.two_cameras import TwoCameras, find_two_cameras
from ipsys_log.errors import IpsysError
from tests.calibration.boards_seen import SIZE_PX, TRUTH, seen

# Cameras of the same type differ less, those with another lens more.
OTHER = (650.0, 650.0, 310.0, 250.0, -0.25, 0.08, 0.001, -0.001, 0.02)


def both(first: Corners, second: Corners) -> Corners:
    return Corners(
        np.concatenate([first.board_m, second.board_m]),
        np.concatenate([first.pixels, second.pixels]),
        np.concatenate([first.image_numbers, second.image_numbers + first.image_count]),
        first.image_count + second.image_count,
    )


def mixed(seed: int, shared_px: float = 0.0, pictures: int = 12) -> Corners:
    rng = np.random.default_rng(seed)
    first = seen("pinhole", rng, pictures, shared_px=shared_px)
    return both(first, seen("pinhole", rng, pictures, shared_px=shared_px, lens=OTHER))


def split(name: str, corners: Corners, names: list[str] | None = None) -> TwoCameras | None:
    model = LENS_MODELS[name]
    names = names or [f"{n}.png" for n in range(corners.image_count)]
    return find_two_cameras(model, find_start(model, corners, SIZE_PX), corners, names)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pictures_of_two_cameras_are_told_apart(seed: int) -> None:
    result = split("pinhole", mixed(seed))
    assert result is not None
    assert agreement(result.second, np.arange(24) >= 12) == 1.0
    assert result.two_px == pytest.approx(0.1 * np.sqrt(2), rel=0.2)
    assert result.one_px > 1.25 * result.two_px


def agreement(groups: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    return float(max(np.mean(groups == truth), np.mean(groups != truth)))


@pytest.mark.parametrize("name", list(TRUTH))
def test_pictures_of_one_camera_are_not_split(name: str) -> None:
    """The corners of an image share errors, as on a curved board."""
    for seed, pictures in ((0, 8), (1, 16), (2, 24)):
        corners = seen(name, np.random.default_rng(seed), pictures, shared_px=0.15)
        assert split(name, corners) is None


def test_names_of_two_kinds_do_not_split_one_camera() -> None:
    corners = seen("pinhole", np.random.default_rng(4), 20)
    assert split("pinhole", corners, [f"{'near' if n < 9 else 'far'}_{n}.jpg" for n in range(20)]) is None


def test_names_separate_similar_cameras() -> None:
    rng = np.random.default_rng(2)
    like = (615.0, 615.0, 350.0, 222.0, -0.23, 0.06, 0.001, -0.001, 0.02)
    corners = both(seen("pinhole", rng, 12), seen("pinhole", rng, 12, lens=like))
    assert split("pinhole", corners) is None
    result = split("pinhole", corners, [f"{'left' if n < 12 else 'right'}_{n}.jpg" for n in range(24)])
    assert result is not None
    assert agreement(result.second, np.arange(24) >= 12) >= 0.9


def calibrated(corners: Corners, insist: bool = False) -> CalibrationResult:
    sightings = tuple(
        BoardSighting(f"{'ab'[n >= 12]}{n}.png", np.arange(24), pixels, 0.8, pixels[[0, 5, 23, 18]])
        for n, pixels in enumerate(corners.pixels.reshape(-1, 24, 2))
    )
    looked = SearchResult(corners.image_count, SIZE_PX, sightings, ())
    return calibrate("red", looked, Board(6, 4, 0.03), LENS_MODELS["pinhole"], insist)


def test_two_cameras_are_refused_with_their_pictures() -> None:
    with pytest.raises(IpsysError, match=r"of two cameras") as caught:
        calibrated(mixed(1))
    for letter, numbers in (("a", range(12)), ("b", range(12, 24))):
        assert ", ".join(f"{letter}{n}.png" for n in numbers) in str(caught.value)
    assert "into a separate folder; or use --force" in str(caught.value)


def test_two_cameras_insisted_on_are_one() -> None:
    result = calibrated(mixed(1), insist=True)
    assert any(
        "written only because of --force: the pictures are of two cameras" in note for note in result.notes
    )
