"""The size of a board: the user's size counts, unless most images show another size."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board, parse_board
from ipsys_log.calibration.board_search import SearchResult, search_images
from ipsys_log.calibration.calibrate import calibrate
from ipsys_log.calibration.chessboard import complete_grid, find_chessboard
from ipsys_log.calibration.lens_models import LENS_MODELS
from ipsys_log.errors import IpsysError
from tests.calibration.boards_seen import chessboard_pattern, photograph, striped_pattern
from tests.calibration.test_board_detection import charuco_pattern

SQUARE_M = 0.03
SIZE_PX = (640, 400)
LENS = (490.0, 490.0, 325.0, 196.0, -0.2, 0.05, 0.001, -0.001, 0.0)
Grey = NDArray[np.uint8]


@cache
def striped(margin: float, stripe: float, phase: float, count: int = 7) -> list[Grey]:
    """Return images of a board of 8 x 6 inner corners on paper with a narrow margin, over stripes."""
    half_m = ((4.5 + margin) * SQUARE_M, (3.5 + margin) * SQUARE_M)
    pattern = striped_pattern(8, 6, SQUARE_M, margin, stripe, phase)
    return photograph(pattern, half_m, LENS, SIZE_PX, count, 3, (0.33, 0.7))


@cache
def plain(columns: int, rows: int) -> list[Grey]:
    half_m = ((columns + 2.4) / 2 * SQUARE_M, (rows + 2.4) / 2 * SQUARE_M)
    return photograph(chessboard_pattern(columns, rows, SQUARE_M), half_m, LENS, SIZE_PX, 4, 4, (0.4, 0.7))


@cache
def charuco(columns: int, rows: int) -> list[Grey]:
    board = Board(columns, rows, SQUARE_M, 0.75, "DICT_4X4_50")
    half_m = ((columns + 1.4) / 2 * SQUARE_M, (rows + 1.4) / 2 * SQUARE_M)
    return photograph(charuco_pattern(board), half_m, LENS, SIZE_PX, 4, 5, (0.33, 0.42))


def seen(pictures: list[Grey], board: str, insist: bool = False) -> SearchResult:
    named = [(f"{n}.png", picture) for n, picture in enumerate(pictures)]
    wanted = parse_board(board, SQUARE_M, 0.75, "DICT_4X4_50", False)
    return search_images(named, wanted, len(pictures), "red", force=insist)


# Margin, width and phase of the stripes are in squares. The stripe beside the paper is dark above, or on both
# sides, or the stripes almost continue the squares.
STRIPES = [(0.2, 1.0, -1.2), (0.1, 2.0, -1.1)]


# A search over a rendered set of images.
@pytest.mark.slow
@pytest.mark.parametrize("stripes", STRIPES)
def test_board_over_stripes_right_size_gives_the_lens(stripes: tuple[float, float, float]) -> None:
    """The edge of the paper before a dark stripe looks like another row of corners."""
    looked = seen(striped(*stripes), "8x6")
    assert len(looked.sightings) >= 6
    result = calibrate("red", looked, Board(8, 6, SQUARE_M), LENS_MODELS["pinhole4"])
    assert result.values[0] == pytest.approx(LENS[0], rel=0.005)
    assert result.rms_px < 0.1
    assert result.outlier_corners < 0.02 * len(result.pixels)


@pytest.mark.slow
@pytest.mark.parametrize("stated", ["8x7", "9x6"])
def test_board_over_stripes_wrong_size_is_refused(stated: str) -> None:
    with pytest.raises(IpsysError, match=r"give --board 8x6"):
        seen(striped(*STRIPES[0])[:4], stated)


def slow(true: tuple[int, int], stated: str) -> object:
    return pytest.param(true, stated, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("true", "stated"),
    [
        ((8, 6), "5x6"), ((8, 6), "7x5"), ((8, 6), "9x7"),
        slow((8, 6), "4x3"), slow((8, 6), "9x5"), slow((8, 6), "charuco:9x7"), slow((6, 6), "7x6"),
    ],
)  # fmt: skip
def test_chessboard_of_other_size_is_named_at_once(true: tuple[int, int], stated: str) -> None:
    wanted = f"--board ({true[0]}x{true[1]}|{true[1]}x{true[0]})"
    with pytest.raises(IpsysError, match=wanted):
        seen(plain(*true)[:3], stated)


@pytest.mark.parametrize("stated", ["8x6", "6x8"])
def test_chessboard_turned_by_a_quarter_is_accepted(stated: str) -> None:
    looked = seen(plain(8, 6), stated)
    assert len(looked.sightings) == 4
    assert looked.unseen == ()


def test_part_of_a_board_insisted_on_is_used() -> None:
    """All detected corners are real, so any part of them gives the intrinsics."""
    looked = seen(plain(8, 6), "5x6", insist=True)
    assert len(looked.sightings) == 4
    assert {len(sighting.ids) for sighting in looked.sightings} == {30}


@pytest.mark.parametrize("stated", ["7x5", "5x6", "4x7", "6x7"])
def test_charuco_of_other_size_is_named(stated: str) -> None:
    """A 7x5 board has the same number of markers, but longer rows."""
    with pytest.raises(IpsysError, match=r"--board charuco:5x7"):
        seen(charuco(5, 7), f"charuco:{stated}")


def test_charuco_of_right_size_is_accepted() -> None:
    assert len(seen(charuco(5, 7), "charuco:5x7").sightings) == 4


def test_images_without_the_board_are_named_with_a_reason() -> None:
    pictures = [*plain(8, 6), np.full((400, 640), 90, np.uint8), plain(6, 5)[0]]
    looked = seen(pictures, "8x6")
    assert looked.unseen == (
        ("4.png", "the board is not found"),
        ("5.png", "only 6 x 5 of its corners are found"),
    )


def test_images_without_the_board_name_the_next_step() -> None:
    with pytest.raises(IpsysError, match="one less than the squares in each direction"):
        seen([np.full((120, 160), 90, np.uint8)] * 3, "8x6")


def test_grid_with_missing_rows_is_completed() -> None:
    picture = plain(8, 6)[0]
    corners = find_chessboard(picture, (8, 6), thorough=True).corners
    assert corners is not None
    for part in (corners[2:], corners[:, 3:], corners[1:-2, 2:-1], np.rot90(corners)[2:]):
        grid = complete_grid(picture, part)
        assert grid is not None
        assert sorted(grid.shape[:2]) == [6, 8]
        distances = np.linalg.norm(grid.reshape(-1, 1, 2) - corners.reshape(1, -1, 2), axis=2)
        assert distances.min(axis=1).max() < 0.5


def test_grid_with_rows_beside_the_board_is_trimmed() -> None:
    """Return rows of points without corners, beyond the outer squares."""
    picture = plain(8, 6)[0]
    corners = find_chessboard(picture, (8, 6), thorough=True).corners
    assert corners is not None
    beyond = 2 * corners[:1] - corners[1:2]
    grid = complete_grid(picture, np.concatenate([2 * beyond - corners[:1], beyond, corners]))
    assert grid is not None
    np.testing.assert_allclose(grid, corners, atol=1e-9)


def test_grid_of_a_checked_cloth_without_board_is_none() -> None:
    stripes = np.tile(np.repeat([40, 200], 20).astype(np.uint8), (400, 10))
    rows, columns = np.mgrid[40:300:20, 40:300:20]
    assert complete_grid(stripes, np.stack([columns, rows], axis=2).astype(float)) is None
