"""Settings and random numbers of the simulated lab, and of a hall with a grid of cameras."""

import math
import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from enum import IntEnum
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import cv2
import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages.rig_file import check_name

FLOOR_M = 4.88
# Each camera of a hall has this part of the floor: 6 x 4 cameras are above 20 x 15 m.
HALL_SPACING_M = (20 / 6, 15 / 4)
_MOST_IN_ROW = 12
# The cameras of a hall are higher than those of the lab, so that fields of view overlap on all sides.
_MOUNT_HEIGHT_M = 5.0


class Purpose(IntEnum):
    """The purpose of random numbers. A seed depends on these values: never change them, only add new ones."""

    CAMERA = 1
    FLOOR = 2
    PLACES = 3
    TAPE = 4
    SPLIT = 5
    DRIVE = 6
    NOISE_FIELD = 7
    FRAME = 8
    BOARD = 9
    LYING = 10
    UNEVENNESS = 11
    INTRINSICS = 12
    CLOCK = 13
    CORNERS = 14
    WOBBLE = 15
    GEOMETRY = 16
    PRINTS = 17
    WHEELS = 18
    RELAY = 19
    WEEKS = 20
    TOPS = 21
    CLUTTER = 22
    FEET = 23


def random_stream(seed: int, purpose: Purpose, *which: int) -> np.random.Generator:
    """Return the random generator for a purpose, and for one camera or frame of it."""
    return np.random.default_rng([seed, int(purpose), *which])


# Lowest and highest valid value of each setting, by its name.
_RANGES = {
    "seed": (0, 2**63 - 1),
    "width": (160, 7680),
    "height": (120, 4320),
    "marker_length_m": (0.02, 1.0),
    "markers": (1, 1000),
    "stations": (0, 100_000),
    "frames_per_station": (1, 10_000),
    "rate_hz": (1.0, 240.0),
    "row_time_ns": (0, 500_000),
    "exposure_s": (0.0, 1.0),
    "drive_s": (0.0, 86_400.0),
    "drive_speed_m_s": (0.01, 5.0),
    "drive_height_m": (0.0, 1.0),
    "psf_sigma_px": (0.0, 5.0),
    "black": (0.0, 255.0),
    "white": (0.0, 255.0),
    "floor": (0.0, 255.0),
    "noise_sigma": (0.0, 50.0),
    "gamma": (0.5, 4.0),
    "jpeg_quality": (1, 100),
    "mount_height_m": (1.0, 10.0),
    "tape_sigma_m": (0.0, 0.2),
    "ruler_sigma_m": (0.0, 0.1),
    "tape_angle_deg": (0.0, 60.0),
    "top_tilt_deg": (0.0, 60.0),
}


@dataclass(frozen=True, slots=True)
class LabSettings:
    """The settings of the simulated lab; the defaults are the lab of the paper (sect. 3) with three markers.

    Attributes
    ----------
    seed : seed of all random numbers.
    width, height : size of an image in px; the focal length scales with the width (1160 px at 1920).
    cameras : names, in the order of the world's y; in a hall, column after column.
    grid : columns (along x) and rows (along y) of the cameras of a hall, see
        :func:`hall_settings`; None: one row of cameras above a floor of 4.88 m.
    dictionary, marker_length_m, markers : OpenCV's name; side of the black square; number of simultaneous
        markers, with the ids 0, 1, ...
    stations : approximate number of calibration points that each camera sees.
    frames_per_station : frames of each camera in a stationary interval of the markers.
    heights_m : heights of measured markers.
    rate_hz : frames per second of each camera.
    row_time_ns : time between the exposures of two rows (rolling shutter; 31000 is typical); 0 for a global
        shutter.
    exposure_s : exposure time of each row, which blurs moving markers (1/60 is typical); 0 for no blur. The
        time of a frame is the middle of the exposure of its first row.
    drive_s, drive_speed_m_s, drive_height_m : duration, speed and marker height of the robots that drive
        after the measurements.
    psf_sigma_px : sigma of the Gaussian point-spread function of the optics. A pixel then integrates over its
        area.
    black, white, floor : grey levels 0..255 in the image, for every gamma.
    noise_sigma : sigma of the sensor noise, in grey levels in the image.
    gamma : an image contains ``255 * (light / 255) ** (1 / gamma)``; blur acts on the light.
    jpeg_quality : quality of the 4:2:2 JPEG images.
    mount_height_m, tilt_deg : approximate height of the cameras, and range of their tilts.
    tape_sigma_m, ruler_sigma_m : sigma of a measured distance, and of a measured height.
    tape_angle_deg : least angle between the two tapes at a calibration point.
    top_tilt_deg : largest tilt of a marker on its robot. Each marker has its own constant tilt up to this.
    textured : the floor has tiles, planks, tape, cables, clutter and shadows, and people walk on it.

    Raises
    ------
    IpsysError
        A value is impossible for a lab.
    """

    seed: int = 0
    width: int = 1920
    height: int = 1080
    cameras: tuple[str, ...] = ("red", "white", "black")
    grid: tuple[int, int] | None = None
    dictionary: str = "DICT_4X4_100"
    marker_length_m: float = 0.20
    markers: int = 3
    stations: int = 50
    frames_per_station: int = 5
    heights_m: tuple[float, ...] = (0.0, 0.05, 0.10, 0.15, 0.20)
    rate_hz: float = 30.0
    row_time_ns: int = 0
    exposure_s: float = 0.0
    drive_s: float = 15.0
    drive_speed_m_s: float = 0.5
    drive_height_m: float = 0.10
    psf_sigma_px: float = 0.7
    black: float = 35.0
    white: float = 205.0
    floor: float = 150.0
    noise_sigma: float = 2.0
    gamma: float = 1.0
    jpeg_quality: int = 90
    mount_height_m: float = 2.1
    tilt_deg: tuple[float, float] = (0.5, 2.0)
    tape_sigma_m: float = 0.003
    ruler_sigma_m: float = 0.001
    tape_angle_deg: float = 15.0
    top_tilt_deg: float = 0.0
    textured: bool = False

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            _check_range(name, getattr(self, name), low, high)
        for value in self.heights_m:
            _check_range("heights_m", value, 0.0, 1.0)
        if not self.heights_m:
            raise IpsysError("simulator setting heights_m is empty; give at least one height in m")
        if self.black >= self.white:
            raise IpsysError(
                f"simulator setting black ({self.black:g}) must be below white ({self.white:g}); swap them"
            )
        if not self.stations and not self.drive_s:
            raise IpsysError("simulator: nothing to show with stations = 0 and drive_s = 0; set one of them")
        _check_tilt(self.tilt_deg)
        _check_cameras(self.cameras)
        if self.grid is not None and len(self.cameras) != self.grid[0] * self.grid[1]:
            raise IpsysError(
                f"simulator: {len(self.cameras)} cameras for a grid of {self.grid[0]} x {self.grid[1]}; "
                "give each place of the grid one camera"
            )
        _check_dictionary(self.dictionary, self.markers)

    @property
    def floor_m(self) -> tuple[float, float]:
        """The size of the floor along x and y, in m."""
        if self.grid is None:
            return FLOOR_M, FLOOR_M
        return self.grid[0] * HALL_SPACING_M[0], self.grid[1] * HALL_SPACING_M[1]


def read_settings(file: Path | None, changes: Iterable[str]) -> dict[str, Any]:
    """Read settings of `LabSettings` by name, from a TOML file, then from texts such as ``stations=25``."""
    given: dict[str, Any] = {}
    texts = [] if file is None else [(str(file), file.read_bytes())]
    texts += [(f"--set {change}", change.encode()) for change in changes]
    for where, text in texts:
        try:
            table = tomllib.loads(text.decode())
        except ValueError as error:
            raise IpsysError(f"{where}: is not TOML ({error}); write a setting as stations = 25") from error
        given |= dict(_typed(table, where))
    return given


def _typed(table: dict[str, Any], where: str) -> Iterator[tuple[str, Any]]:
    """Yield settings with the types of their defaults: TOML has 1 for 1.0, and arrays for tuples."""
    defaults: dict[str, Any] = {f.name: f.default for f in fields(LabSettings) if f.name != "grid"}
    for name, value in table.items():
        if name not in defaults:
            raise IpsysError(f"{where}: there is no setting {name!r}; use one of {', '.join(defaults)}")
        default = defaults[name]
        is_convertible = (type(value), type(default)) in ((list, tuple), (int, float))
        typed = type(default)(value) if is_convertible else value
        if type(typed) is not type(default):
            raise IpsysError(f"{where}: {name} is {value!r}; give a value such as {default!r}")
        yield name, typed


def parse_grid(text: str) -> tuple[int, int]:
    """Return the columns and rows of a grid of cameras from text such as ``6x4``.

    Examples
    --------
    >>> parse_grid("6x4")
    (6, 4)
    """
    match = re.fullmatch(r"([0-9]{1,6})x([0-9]{1,6})", text)
    if match is None:
        raise IpsysError(f"--cameras {text!r} is not a grid; give columns x rows, such as 6x4")
    columns, rows = int(match[1]), int(match[2])
    if not (1 <= columns <= _MOST_IN_ROW and 1 <= rows <= _MOST_IN_ROW):
        raise IpsysError(
            f"--cameras {text}: give 1 to {_MOST_IN_ROW} columns and 1 to {_MOST_IN_ROW} rows, such as 6x4"
        )
    return columns, rows


def grid_names(columns: int, rows: int) -> tuple[str, ...]:
    """Return the names of the cameras, column after column: a letter for the column, a number for the row.

    Examples
    --------
    >>> grid_names(2, 3)
    ('a1', 'a2', 'a3', 'b1', 'b2', 'b3')
    """
    return tuple(f"{letter}{row + 1}" for letter in ascii_lowercase[:columns] for row in range(rows))


def hall_settings(columns: int, rows: int, **settings: Any) -> LabSettings:
    """Return the settings of a hall; ``settings`` are other settings of the lab.

    Examples
    --------
    >>> hall = hall_settings(6, 4, markers=12)
    >>> len(hall.cameras), [round(size_m, 2) for size_m in hall.floor_m], hall.mount_height_m
    (24, [20.0, 15.0], 5.0)
    """
    settings = {"mount_height_m": _MOUNT_HEIGHT_M, **settings}
    return LabSettings(cameras=grid_names(columns, rows), grid=(columns, rows), **settings)


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise IpsysError(f"simulator setting {name} is {value!r}; give a value between {low:g} and {high:g}")


def _check_tilt(tilt_deg: tuple[float, float]) -> None:
    low, high = tilt_deg
    if not (0.0 <= low <= high <= 45.0):
        raise IpsysError(
            f"simulator setting tilt_deg is {tilt_deg!r}; give the least and the most tilt, "
            "each between 0 and 45 degrees"
        )


def _check_cameras(cameras: tuple[str, ...]) -> None:
    if not cameras:
        raise IpsysError("simulator setting cameras is empty; name at least one camera")
    for camera in cameras:
        check_name(camera, "simulator: camera name")
    if len(set(cameras)) < len(cameras):
        raise IpsysError(
            f"simulator: two cameras have the same name in {', '.join(cameras)}; give each its own"
        )


def _check_dictionary(name: str, markers: int) -> None:
    known = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(known, int):
        raise IpsysError(f"simulator: OpenCV has no marker dictionary {name!r}; use one such as DICT_4X4_100")
    size = len(cv2.aruco.getPredefinedDictionary(known).bytesList)
    if markers > size:
        raise IpsysError(f"simulator: {name} has {size} markers, but markers = {markers}; set fewer markers")
