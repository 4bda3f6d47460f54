"""Simulated lab with live cameras: a calibration board, and markers that are mostly stationary.

Stationary markers can be used for alignment and measured at any time.
"""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board, black_squares, board_markers
from ipsys_log.capture.simulation.calibration_points import (
    REFERENCES,
    SimulatedPose,
    cameras_seeing,
    choose_place,
    place_marker,
    tape_lengths_m,
)
from ipsys_log.capture.simulation.cameras import Camera, Check, FloorView, mount_cameras, prepare_view, sees
from ipsys_log.capture.simulation.drive import Drive, eased_s, plan_drive
from ipsys_log.capture.simulation.lab import build_rig, live_cameras, moving_marker
from ipsys_log.capture.simulation.render import Print, add_static_prints, encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.capture.simulation.textured_floor import feet
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Rig, RigMarker
from ipsys_log.messages.rig_checks import dictionary_size
from ipsys_log.units import CM_PER_M
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import PlacedBoard, print_outline, project_corners, white_cells
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


# A laptop with two cores can draw this lab and track in it. Three cameras send 2.5 MB per second.
LIVE_SETTINGS = LabSettings(
    width=1280, height=720, rate_hz=10.0, stations=18, drive_s=4.0, noise_sigma=1.0, jpeg_quality=80
)
# Most markers are on the floor, for the alignment of cameras; the others are on boxes.
_RAISED_SHARE, _BOXES_M = 0.35, (0.1, 0.2)
# Samples per second of the paths of driving markers. Stationary markers do not overlap these samples.
_CHECKED_HZ = 5
# The plan uses this image size, so the poses do not depend on the size of the images, if they are wide.
_WIDTH, _HEIGHT = 1920, 1080
# In an image of this width, markers have at least this width. The detector may miss narrower markers in
# smaller images.
_NARROWEST_PX = 50.0

# The reference points of the simulated lab are exact: the distance AB shows the scale of its tape.
_AB_SIGMA_M = 0.0005

_planning = Lock()


@dataclass(frozen=True, slots=True, eq=False)
class LiveLab:
    """Poses of markers: those with ids from ``settings.markers`` on are stationary, the others drive."""

    settings: LabSettings
    drive: Drive
    stationary: tuple[SimulatedPose, ...]

    @property
    def images(self) -> int:
        """The number of different images of a camera."""
        return max(round(self.settings.drive_s * self.settings.rate_hz), 1)

    def time_of(self, image: int) -> float:
        """Return the time of the drive in an image, in s; the robots brake before they turn back."""
        last = self.images - 1
        if not image:
            return 0.0
        left, whole = eased_s(np.array([last - image, last]) / self.settings.rate_hz)
        return float(1 - left / whole) * last / self.settings.rate_hz


def plan_live_lab(settings: LabSettings) -> LiveLab:
    """Plan a lab in which each camera sees about ``settings.stations`` stationary markers.

    Parameters
    ----------
    settings : settings of the lab. All determine the poses, except size, rate and quality of the images.

    Examples
    --------
    >>> lab = plan_live_lab(LabSettings(stations=4, markers=2, drive_s=2.0))
    >>> [place.marker_id for place in lab.stationary][:3], sorted(lab.drive.ahead_s)
    ([2, 3, 4], [0, 1])
    """
    shape = replace(settings, width=_WIDTH, height=_HEIGHT, rate_hz=LIVE_SETTINGS.rate_hz)
    with _planning:  # the cameras of a lab open at the same time, and share one plan
        drive, stationary = _plan(shape)
    return LiveLab(settings, drive, stationary)


@lru_cache(maxsize=4)
def _plan(settings: LabSettings) -> tuple[Drive, tuple[SimulatedPose, ...]]:
    cameras = mount_cameras(settings)
    drive = plan_drive(settings, cameras)
    times_s = np.linspace(0, settings.drive_s, round(settings.drive_s * _CHECKED_HZ) + 1).tolist()
    taken = [pose for time_s in times_s for pose in drive.poses_at(time_s)]
    rng = random_stream(settings.seed, Purpose.LYING)
    seen: dict[str, list[SimulatedPose]] = {camera.name: [] for camera in cameras}
    stationary: list[SimulatedPose] = []
    while min(map(len, seen.values())) < settings.stations:
        camera = min(cameras, key=lambda one: len(seen[one.name]))
        number = settings.markers + len(stationary)
        _check_left(settings, number)
        level = replace(settings, heights_m=(_next_height_m(stationary, seen[camera.name]),))
        others = [*taken, *stationary]
        pose = choose_place(rng, level, cameras, camera, number, others, seen[camera.name], _is_wide)
        stationary.append(pose)
        for name in cameras_seeing(pose, cameras, settings):
            seen[name].append(pose)
    return drive, tuple(stationary)


def _next_height_m(stationary: Sequence[SimulatedPose], seen: Sequence[SimulatedPose]) -> float:
    """Return the height of the next marker: each camera sees only a small share of raised markers."""
    raised = sum(pose.z_m > 0 for pose in seen)
    if raised >= _RAISED_SHARE * len(seen):
        return 0.0
    return _BOXES_M[sum(pose.z_m > 0 for pose in stationary) % len(_BOXES_M)]


def _is_wide(where: SimulatedPose, camera: Camera, settings: LabSettings) -> bool:
    """Return whether a marker is wide enough in the image of a camera with a slanted view."""
    corners_px = project_corners(camera.lens, camera.camera_from_world, place_marker(where, settings))
    area_px = cv2.contourArea(corners_px.astype(np.float32))
    longest_px = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1).max()
    return bool(area_px / longest_px >= _NARROWEST_PX)


def _check_left(settings: LabSettings, number: int) -> None:
    """Check that the dictionary has a marker of this number."""
    size = dictionary_size(settings.dictionary)
    if size is not None and number >= size:
        raise IpsysError(
            f"simulator: {settings.dictionary} has {size} markers, too few for {settings.markers} robots and "
            f"{settings.stations} calibration points before each camera; set fewer stations"
        )


def live_rig(settings: LabSettings) -> Rig:
    """Return the rig of the live lab: each camera with its source, each marker with its height."""
    rig = build_rig(settings)
    stationary = plan_live_lab(settings).stationary
    still = (RigMarker(pose.marker_id, height_m=pose.z_m) for pose in stationary)
    markers = (*rig.markers, *still)
    return replace(rig, cameras=live_cameras(settings), markers=markers, ab_sigma_m=_AB_SIGMA_M)


def tape_sheet(stationary: Sequence[SimulatedPose]) -> str:
    """Return the tape and ruler readings of stationary markers, as a sheet for ``ipsys measure --csv``.

    Examples
    --------
    >>> print(tape_sheet([SimulatedPose(3, 1.2192, 3.4384, 0.1, 0.0)]))
    marker,d_A_cm,d_B_cm,side,height_cm
    3,100.0,263.5,left,10.0
    <BLANKLINE>
    """
    a, b = REFERENCES
    rows = [f"marker,d_{a.name}_cm,d_{b.name}_cm,side,height_cm"]
    for pose in stationary:
        tapes = ",".join(f"{CM_PER_M * length_m:.1f}" for length_m in tape_lengths_m(pose).tolist())
        side = "left" if pose.y_m >= a.y_m else "right"
        rows.append(f"{pose.marker_id},{tapes},{side},{CM_PER_M * pose.z_m:.1f}")
    return "\n".join(rows) + "\n"


# Duration of each pose of a board, in s.
_HOLD_S = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """The images of a camera, and the image index of each frame.

    ``draw`` returns the JPEG image of an index from 0 to ``count`` - 1. ``index_of`` returns the index for
    the number of a frame since 1970, so all cameras of a lab agree. The film repeats after ``period`` frames.
    """

    count: int
    period: int
    draw: Callable[[int], bytes]
    index_of: Callable[[int], int]


def lab_film(settings: LabSettings, number: int, check: Check) -> Film:
    """Return the film of one camera of the live lab, with stationary markers and driving ones.

    Parameters
    ----------
    settings : settings of the lab; the robots drive for ``drive_s`` in one direction.
    number : number of the camera in the lab.
    check : called between the steps; its exceptions end the work.
    """
    lab = plan_live_lab(settings)
    count = lab.images
    check()
    bare = prepare_view(mount_cameras(settings)[number], settings, check)
    view = add_static_prints(bare, [place_marker(pose, settings) for pose in lab.stationary], settings)

    def draw(index: int) -> bytes:
        return _picture(view, _moving_marker(lab, index), settings, number, index)

    return Film(count, max(2 * count - 2, 1), draw, lambda frame: image_index(frame, count))


def board_film(settings: LabSettings, number: int, board: Board, check: Check) -> Film:
    """Return the film of a camera with a calibration board, in one pose after the other.

    Parameters
    ----------
    settings, number, check : as for :func:`lab_film`.
    board : the calibration board.
    """
    camera = mount_cameras(settings)[number]
    poses = board_poses(board, camera, settings)
    view = prepare_view(camera, settings, check)
    frames_per_pose = max(round(_HOLD_S * settings.rate_hz), 1)

    def draw(index: int) -> bytes:
        return _picture(view, [poses[index]], settings, number, index)

    return Film(
        len(poses), len(poses) * frames_per_pose, draw, lambda frame: frame // frames_per_pose % len(poses)
    )


def image_index(frame: int, count: int) -> int:
    """Return the index of the image, of ``count`` images, for a frame number: back and forth.

    Examples
    --------
    >>> [image_index(frame, 4) for frame in range(8)]
    [0, 1, 2, 3, 2, 1, 0, 1]
    """
    turn = frame % max(2 * count - 2, 1)
    return min(turn, 2 * count - 2 - turn)


def next_missing(film: Film, drawn: Container[int], frame: int) -> int | None:
    """Return the index of the next image, from a frame on, that is not drawn yet; None if all are drawn.

    Examples
    --------
    >>> film = Film(4, 6, lambda index: b"", lambda frame: image_index(frame, 4))
    >>> next_missing(film, {2, 3}, 2), next_missing(film, {0, 1, 2, 3}, 2)
    (1, None)
    """
    indices = (film.index_of(number) for number in range(frame, frame + film.period))
    return next((index for index in indices if index not in drawn), None)


def _moving_marker(lab: LiveLab, index: int) -> list[Print]:
    time_s = lab.time_of(index)
    markers = [moving_marker(lab.drive, marker_id, time_s, lab.settings) for marker_id in lab.drive.ahead_s]
    return [*feet(lab.settings, time_s), *markers]


def _picture(view: FloorView, prints: list[Print], settings: LabSettings, number: int, index: int) -> bytes:
    rng = random_stream(settings.seed, Purpose.FRAME, number, index)
    return encode_jpeg(render(view, prints, settings, rng), settings)
