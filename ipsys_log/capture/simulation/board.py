"""Calibration board in front of a simulated camera, in one pose after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board, black_squares, board_markers
from ipsys_log.capture.simulation.cameras import Camera, sees
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.errors import IpsysError
from ipsys_log.messages.arrays import Array
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import PlacedBoard, print_outline, white_cells
from ipsys_log.vision.poses import invert_pose, make_pose, rotation

# Positions in the image, as shares of it, from left to right and from top to bottom; each twice.
_COLUMNS, _ROWS = np.linspace(0.08, 0.92, 5), np.linspace(0.08, 0.92, 3)
POSES = 2 * len(_COLUMNS) * len(_ROWS)
# Width of the board, as a share of the image width; tilt of the board against the line of sight, and largest
# roll, in degrees.
_SHARES, _TILTS_DEG, _ROLL_DEG = (0.28, 0.42), (12.0, 38.0), 25.0
# White margin around the squares, in squares. With a margin of 1, the edge of the paper looks like a row of
# squares.
_MARGIN = 0.75
_GOLDEN_RAD = 2.399963
_TRIES = 60


def board_cells(board: Board) -> tuple[NDArray[np.bool_], float]:
    """Return a mask of the black cells of a printed board, with its white margin, and a cell's side in m.

    Raises
    ------
    IpsysError
        The cells of the markers of a ChArUco board do not divide a square evenly.
    """
    per_square = _cells_per_square(board)
    black = black_squares(board).repeat(per_square, axis=0).repeat(per_square, axis=1)
    for marker in board_markers(board):
        dark = ~white_cells(board.dictionary, marker.id)
        gap = (per_square - len(dark)) // 2
        top, left = marker.row * per_square + gap, marker.column * per_square + gap
        black[top : top + len(dark), left : left + len(dark)] = dark
    black = np.pad(black, round(_MARGIN * per_square))
    return (~black if board.inverted else black), board.square_m / per_square


def _cells_per_square(board: Board) -> int:
    if board.marker_scale is None:
        return 4
    cells = len(white_cells(board.dictionary, 0))
    per_square = round(cells / board.marker_scale)
    if abs(per_square * board.marker_scale - cells) > 1e-6 or (per_square - cells) % 2:
        fitting = cells / (cells + 2)
        raise IpsysError(
            f"the simulated lab has no {board.dictionary} board with --marker-scale "
            f"{board.marker_scale:g}; give {fitting:.6g}"
        )
    return per_square


def board_poses(board: Board, camera: Camera, settings: LabSettings) -> list[PlacedBoard]:
    """Return a board in :data:`POSES` poses, which cover the image of a camera, with tilts to all sides.

    Parameters
    ----------
    board : a board that :func:`board_cells` accepts.
    camera : the camera. Its image contains the whole print in each pose.
    settings : the seed.
    """
    cells, cell_m = board_cells(board)
    rng = random_stream(settings.seed, Purpose.BOARD, settings.cameras.index(camera.name))
    positions = [(x, y) for _ in range(2) for y in _ROWS for x in _COLUMNS]
    return [
        _hold(cells, cell_m, camera, settings, rng, index, np.array(place))
        for index, place in enumerate(positions)
    ]


def _hold(
    cells: NDArray[np.bool_],
    cell_m: float,
    camera: Camera,
    settings: LabSettings,
    rng: np.random.Generator,
    index: int,
    place: Array,
) -> PlacedBoard:
    """Move a tilted board towards the middle of the image until the image contains the whole board."""
    lens, world_from_camera = camera.lens, invert_pose(camera.camera_from_world)
    width_m = max(cells.shape) * cell_m
    distance_m = width_m * lens.K[0, 0] / (rng.uniform(*_SHARES) * lens.width)
    towards, tilt = index * _GOLDEN_RAD, np.radians(rng.uniform(*_TILTS_DEG))
    roll = rotation(np.array([0.0, 0.0, np.radians(rng.uniform(-_ROLL_DEG, _ROLL_DEG))]))
    turn = rotation(tilt * np.array([np.cos(towards), np.sin(towards), 0.0])) @ roll
    for share in np.linspace(1, 0, _TRIES):
        pixel = (0.5 + share * (place - 0.5)) * [lens.width - 1, lens.height - 1]
        ray = np.append(undistort(pixel[None], lens)[0], 1.0)
        ray /= np.linalg.norm(ray)
        axes = _facing(ray) @ turn
        pose = world_from_camera @ make_pose(axes, ray * distance_m)
        placed = PlacedBoard(cells, cell_m, pose)
        if sees(camera, print_outline(placed, settings.dictionary)).all():
            return placed
    raise IpsysError(
        f"simulator: camera {camera.name!r} cannot see the whole board; give wider frames, such as 16:9"
    )


def _facing(ray: Array) -> Array:
    """Return the axes (3, 3), in camera coordinates, of a board that faces the camera, y up in the image."""
    right = np.cross([0.0, 1.0, 0.0], ray)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(-ray, right), -ray])
