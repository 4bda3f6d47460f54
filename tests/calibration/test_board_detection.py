"""Corners and sharpness in rendered images with ground truth, and the selection of images."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ipsys_log.calibration.board import Board, parse_board
from ipsys_log.calibration.board_detection import BoardSighting, find_board
from ipsys_log.calibration.board_search import MAX_IMAGES, search_images, select_images
from ipsys_log.errors import IpsysError
from tests.calibration.boards_seen import Array, chessboard_pattern, pixels_of, random_pose, render

PINHOLE = (600.0, 600.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0, 0.0)
CHESSBOARD = Board(6, 4, 0.03)
CHARUCO = Board(5, 4, 0.03, 0.75, "DICT_4X4_50")


def straight_rays(pixels: Array) -> Array:
    rays = np.column_stack([(pixels - PINHOLE[2:4]) / PINHOLE[:2], np.ones(len(pixels))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def charuco_pattern(board: Board, legacy: bool = False) -> Callable[[Array], Array]:
    """Return grey levels at points of a ChArUco board, in the layout of OpenCV 4.6 or the older one."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    printed = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, board.marker_scale or 0, dictionary)
    printed.setLegacyPattern(legacy)
    picture = printed.generateImage((board.columns * 240, board.rows * 240))
    size = np.array([board.columns, board.rows])

    def levels(places_m: Array) -> Array:
        squares = places_m / board.square_m + size / 2
        inside = ((squares >= 0) & (squares < size)).all(axis=1)
        column, row = np.clip(squares * 240, 0, size * 240 - 1).astype(int).T
        margin = ((squares >= -0.7) & (squares < size + 0.7)).all(axis=1)
        return np.where(inside, 40 + picture[row, column] / 255 * 160, np.where(margin, 200.0, 120.0))

    return levels


@cache
def scene(board: Board, seed: int, z_m: float, legacy: bool) -> tuple[NDArray[np.uint8], Array]:
    """Return a sharp image of a board, and its true corners."""
    rng = np.random.default_rng(seed)
    turn, place_m = random_pose(rng, "pinhole")
    place_m = np.array([0.1 * place_m[0], 0.1 * place_m[1], z_m])
    if board.marker_scale is None:
        pattern = chessboard_pattern(board.columns, board.rows, board.square_m)
    else:
        pattern = charuco_pattern(board, legacy)
    picture = render(straight_rays, turn, place_m, pattern, (640, 480), rng)
    corners = board.points_m(np.arange(board.grid[0] * board.grid[1])) @ turn.T + place_m
    return picture, pixels_of("pinhole", PINHOLE, corners)


def drawn(
    board: Board, seed: int, blur_px: float, gamma: float = 1.0, z_m: float = 0.42, legacy: bool = False
) -> tuple[NDArray[np.uint8], Array]:
    """Return an image of a board as a camera takes it, and its true corners."""
    picture, truth = scene(board, seed, z_m, legacy)
    light = gaussian_filter(picture.astype(float), blur_px)
    return np.round(255 * (light / 255) ** (1 / gamma)).astype(np.uint8), truth


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_corners_are_where_they_are(board: Board, gamma: float) -> None:
    """The squares are 26 px wide; OpenCV's own corners have an error of 0.07 to 0.08 px here."""
    errors = []
    for seed in range(3):
        picture, truth = drawn(board, seed, blur_px=0.7, gamma=gamma, z_m=0.7)
        sighting = find_board("a", picture, board, thorough=True)
        assert sighting is not None
        # A chessboard with even numbers of corners looks the same upside down.
        turned = [truth[sighting.ids], truth[::-1][sighting.ids]]
        distances = [np.linalg.norm(sighting.pixels - corners, axis=1) for corners in turned]
        errors.append(min(distances, key=lambda each: float(np.median(each))))
    rms_px = np.sqrt((np.concatenate(errors) ** 2).mean())
    assert rms_px < 0.055
    assert np.concatenate(errors).max() < 0.15


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_the_blur_of_a_picture_is_measured(board: Board) -> None:
    widths = []
    for blur_px in (0.7, 1.5):
        sighting = find_board("a", drawn(board, 1, blur_px)[0], board, thorough=True)
        assert sighting is not None
        widths.append(sighting.blur_px)
    # The width of the pixel itself is 0.29 px (standard deviation).
    assert widths[0] == pytest.approx(np.hypot(0.7, 0.29), abs=0.2)
    assert widths[1] == pytest.approx(np.hypot(1.5, 0.29), abs=0.4)


def test_a_blur_in_one_direction_is_a_blur() -> None:
    picture, _ = drawn(CHESSBOARD, 1, 0.7)
    moved = cv2.blur(picture, (9, 1))
    sighting = find_board("a", np.asarray(moved, dtype=np.uint8), CHESSBOARD, thorough=True)
    assert sighting is not None
    assert sighting.blur_px > 2.0


def test_an_inverted_board() -> None:
    picture, _ = drawn(CHARUCO, 2, 0.7)
    negative = np.asarray(255 - picture, dtype=np.uint8)
    assert find_board("a", negative, CHARUCO, thorough=False) is None
    inverted = parse_board("charuco:5x4", 0.03, 0.75, "DICT_4X4_50", True)
    sighting = find_board("a", negative, inverted, thorough=False)
    assert sighting is not None
    assert len(sighting.ids) == 12


def test_large_image_is_searched_at_half_size() -> None:
    picture, truth = drawn(CHESSBOARD, 1, 0.7)
    large = np.asarray(cv2.resize(picture, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    sighting = find_board("a", large, CHESSBOARD, thorough=False)
    assert sighting is not None
    off = [np.linalg.norm(sighting.pixels - (3 * corners + 1), axis=1) for corners in (truth, truth[::-1])]
    assert min(float(each.max()) for each in off) < 0.3


def test_a_board_as_opencv_printed_it_before_4_6() -> None:
    """With an even number of rows, the board begins with a white square."""
    picture, truth = drawn(CHARUCO, 2, 0.7, legacy=True)
    assert (picture != drawn(CHARUCO, 2, 0.7)[0]).mean() > 0.1
    sighting = find_board("a", picture, CHARUCO, thorough=False)
    assert sighting is not None
    assert len(sighting.ids) == 12
    assert np.abs(sighting.pixels - truth[sighting.ids]).max() < 0.15


def test_mirrored_images_are_reported() -> None:
    """Markers are not found in a mirrored image. A chessboard is found, because it looks the same."""
    pictures = [np.ascontiguousarray(drawn(CHARUCO, seed, 0.7)[0][:, ::-1]) for seed in range(2)]
    said = "it is mirrored in 2 of 2 checked"
    with pytest.raises(IpsysError, match=said):
        search_images([("a", pictures[0]), ("b", pictures[1])], CHARUCO, 2, "red")


def test_equal_image_names_may_have_different_sizes() -> None:
    """Two folders of one camera may have images of the same name."""
    grey = drawn(CHARUCO, 0, 0.7)[0]
    small = np.ascontiguousarray(grey[100:, 100:])
    looked = search_images([("a", grey), ("a", small), ("a", grey), ("a", grey)], CHARUCO, 4, "red")
    assert len(looked.sightings) == 3
    assert looked.unreadable == (("a", "is 540 x 380 px, most are 640 x 480"),)


def sighting(name: str, x: float, y: float, blur_px: float = 0.8, count: int = 24) -> BoardSighting:
    """Return a board of 100 x 60 px with its upper left corner at x, y."""
    ids = np.arange(count)
    pixels = CHESSBOARD.grid_positions(ids) * 20 + (x, y)
    outline = np.array([[0.0, 0], [100, 0], [100, 60], [0, 60]]) + np.array([x, y])
    return BoardSighting(name, ids, pixels, blur_px, outline)


def test_blurred_images_and_few_corners_are_dropped_with_a_reason() -> None:
    seen = [sighting(str(n), 30 * n, 10) for n in range(10)]
    seen += [sighting("shaken", 100, 200, blur_px=3.5), sighting("half", 200, 200, count=4)]
    seen += [sighting("row", 300, 200, count=6)]
    chosen = select_images(seen, CHESSBOARD, (640, 480))
    assert len(chosen.used) == 10
    reasons = dict(chosen.bad)
    assert reasons["shaken"] == "blurred: edges are 3.5 px wide, but 0.8 px in sharp pictures"
    assert reasons["half"] == "only 4 corners are found"
    assert reasons["row"] == "its corners lie on one line"


def test_selection_takes_some_different_frames_of_many() -> None:
    """The board is stationary for most of a video, and then moves all over the image."""
    still = [sighting(f"still {n}", 300, 200) for n in range(200)]
    moving = [sighting(f"{x} {y}", x, y) for x in range(0, 540, 20) for y in range(0, 420, 20)]
    chosen = select_images([*still, *moving], CHESSBOARD, (640, 480))
    assert len(chosen.used) == MAX_IMAGES
    assert sum(s.name.startswith("still") for s in chosen.used) <= 1
    corners = np.concatenate([s.pixels for s in chosen.used])
    assert corners.min(axis=0).tolist() == [0, 0]
    assert corners.max(axis=0).tolist() == [620, 460]
    assert "nearly the same pose as" in chosen.spare[0].reason


def test_selection_takes_the_sharper_of_two_equal_views() -> None:
    seen = [sighting(f"{x}", x, 10, blur_px=0.8 + (x % 2)) for x in range(400)]
    chosen = select_images(seen, CHESSBOARD, (640, 480))
    assert np.mean([s.blur_px < 1 for s in chosen.used]) > 0.9


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("6", "write the inner corners of a chessboard as 6x4"),
        ("charuco:5", "charuco:4x5"),
        ("2x9", "3 to 100 inner corners"),
        ("charuco:50x50", "has 50 markers, but the board has 1250"),
    ],
)
def test_impossible_boards_are_refused(text: str, said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        parse_board(text, 0.03, 0.75, "DICT_4X4_50", False)


@pytest.mark.slow
def test_chessboard_instead_of_charuco_is_reported() -> None:
    pictures = [(f"{seed}", drawn(CHESSBOARD, seed, 1.0)[0]) for seed in range(3)]
    tried: list[tuple[int, int]] = []
    with pytest.raises(
        IpsysError, match="but a chessboard of 6 x 4 inner corners is in 3 of 3 checked pictures"
    ):
        search_images(
            pictures,
            Board(7, 5, 0.03, 0.75),
            3,
            "red",
            trying=lambda done, total: tried.append((done, total)),
        )
    assert tried[0][0] == 0
    assert len(tried) > 3
    assert {total for _, total in tried} == {tried[0][1]}
