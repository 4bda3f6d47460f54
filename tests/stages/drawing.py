"""Frames with ground truth, drawn independently of the simulator.

Each pixel of a print is the mean of 8 by 8 samples. Each sample is a random ray in its own part of the
pixel.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.messages import (
    CameraCalibration,
    CompressedImage,
    Marker,
    Markers,
    Message,
    RawImage,
    Rig,
    RigCamera,
    RigMarker,
)
from ipsys_log.stages.detect import Detect

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Cells = Mapping[tuple[int, int], float]

SAMPLES = 8
K = np.array([[1157.3, 0, 948.2], [0, 1158.9, 551.7], [0, 0, 1]])
FISHEYE = CameraCalibration(
    0, "red", 1920, 1080, "kannala_brandt", np.array([-0.128, 0.012, -0.031, 0.018]), K
)
_K_SMALL = np.array([[905.0, 0, 633.4], [0, 903.1, 366.8], [0, 0, 1]])
PLUMB_BOB = CameraCalibration(
    0, "red", 1280, 720, "plumb_bob", np.array([-0.21, 0.05, 0.001, -0.0015, -0.004]), _K_SMALL
)
RATIONAL = CameraCalibration(
    0,
    "red",
    1280,
    720,
    "rational_polynomial",
    np.array([0.31, 0.04, 0.0008, -0.001, 0.003, 0.49, 0.11, 0.01]),
    _K_SMALL,
)
_K_VGA = np.array([[402.0, 0, 321.7], [0, 401.1, 236.9], [0, 0, 1]])
VGA = CameraCalibration(
    0, "red", 640, 480, "kannala_brandt", np.array([-0.128, 0.012, -0.031, 0.018]), _K_VGA
)


class Print(NamedTuple):
    """A marker in the frame of the camera; ``covered`` gives grey levels to some of its cells, (row, column)
    of the black square."""

    id: int
    axes: Array
    centre_m: Array
    length_m: float = 0.2
    covered: Cells = {}  # noqa: RUF012 - nobody writes into it


@dataclass(frozen=True)
class Look:
    """The appearance of a scene. ``floor`` and ``shade`` (a share of the light) are one number or (h, w)."""

    black: float = 35.0
    white: float = 205.0
    floor: float | Array = 150.0
    shade: float | Array = 1.0
    glare: float | Array = 0.0
    margin_cells: float = 1.0
    dictionary: str = "DICT_4X4_100"
    psf_px: float = 0.7
    noise: float = 2.0
    gamma: float = 1.0
    seed: int = field(default=0, kw_only=True)


def corners_px(lens: CameraCalibration, one: Print, sides: float = 1.0) -> Array:
    """Return the corners (4, 2) of the black square, or of a larger square, in a perfect camera."""
    half = sides * one.length_m / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    return _project(lens, square @ one.axes.T + one.centre_m)


def print_px(lens: CameraCalibration, one: Print, look: Look) -> Array:
    """Return the corners of the white margin."""
    cells = _black(look.dictionary, one.id).shape[0]
    return corners_px(lens, one, (cells + 2 * look.margin_cells) / cells)


def draw(lens: CameraCalibration, prints: Sequence[Print], look: Look) -> Picture:
    """Draw the grey frame (h, w) of prints on a floor, the last one on top."""
    rng = np.random.default_rng(look.seed)
    light = np.broadcast_to(_light(look.floor, look), (lens.height, lens.width)).copy()
    for one in prints:
        _draw_print(light, lens, one, look, rng)
    light = light * look.shade + look.glare
    levels = 255 * (np.clip(light, 0, 255) / 255) ** (1 / look.gamma)
    levels += look.noise * rng.standard_normal(levels.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def jpeg(grey: Picture, quality: int = 90, *options: int) -> bytes:
    """Encode a frame as a camera sends it, in colour."""
    options = (cv2.IMWRITE_JPEG_QUALITY, quality, *options)
    return cv2.imencode(".jpg", cv2.merge([grey, grey, grey]), options)[1].tobytes()


def strewn(
    lens: CameraCalibration,
    count: int,
    rng: np.random.Generator,
    look: Look = Look(),
    length_m: float = 0.2,
    height_m: tuple[float, float] = (1.9, 2.1),
    tilt_deg: float = 5.0,
) -> list[Print]:
    """Return markers 0, 1, ... side by side at random positions, with their margins inside the image."""
    found: list[Print] = []
    middles: list[Array] = []
    while len(found) < count:
        z = rng.uniform(*height_m)
        middle = rng.uniform(0, (lens.width, lens.height))
        u, v = _rays(lens, middle[None])[0]
        one = Print(len(found), turned(rng, tilt_deg), np.array([u * z, v * z, z]), length_m)
        outline_px = print_px(lens, one, look)
        inside = (outline_px > 1).all() and (outline_px < (lens.width - 2, lens.height - 2)).all()
        breadth_px = np.ptp(outline_px, axis=0).max()
        if inside and all(np.abs(middle - other).max() > 1.3 * breadth_px for other in middles):
            found.append(one)
            middles.append(middle)
    return found


def turned(rng: np.random.Generator, tilt_deg: float) -> Array:
    """Return the axes of a marker that faces the camera, rotated at random and tilted by up to an angle."""
    about = rng.uniform(0, 2 * np.pi)
    tilt = np.radians(rng.uniform(0, tilt_deg)) * np.array([np.cos(about), np.sin(about), 0.0])
    return facing(rng.uniform(-np.pi, np.pi), tilt)


def facing(heading_rad: float, tilt_rad: Sequence[float] | Array = (0.0, 0.0, 0.0)) -> Array:
    """Return the axes of a marker that faces the camera, rotated in its plane, then by a rotation vector."""
    upright = Rotation.from_euler("z", heading_rad) * Rotation.from_euler("x", np.pi)
    return np.asarray((Rotation.from_rotvec(tilt_rad) * upright).as_matrix())


def at_px(
    lens: CameraCalibration,
    marker_id: int,
    middle_px: tuple[float, float],
    z_m: float = 2.0,
    heading_rad: float = 0.3,
    length_m: float = 0.2,
    tilt_rad: Sequence[float] = (0.0, 0.0, 0.0),
) -> Print:
    """Return a marker whose centre is at a given point of the image."""
    u, v = _rays(lens, np.array([middle_px], dtype=np.float64))[0]
    return Print(marker_id, facing(heading_rad, tilt_rad), np.array([u * z_m, v * z_m, z_m]), length_m)


def texture(lens: CameraCalibration, seed: int, mean: float = 140.0, spread: float = 18.0) -> Array:
    """Draw a floor with spots of all sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros((lens.height, lens.width))
    for blotch_px in (3, 10, 40, 160):
        shape = (lens.height // blotch_px + 2, lens.width // blotch_px + 2)
        total += cv2.resize(
            rng.standard_normal(shape), (lens.width, lens.height), interpolation=cv2.INTER_CUBIC
        )
    return np.asarray(mean + spread * total / total.std())


def tiles(lens: CameraCalibration, low: float = 90.0, high: float = 170.0, size_px: int = 45) -> Array:
    """Draw a floor of light and dark squares, as large as marker cells."""
    y, x = np.mgrid[: lens.height, : lens.width] // size_px
    return np.where((x + y) % 2 == 0, low, high).astype(np.float64)


def vignette(lens: CameraCalibration, corner: float = 0.35, slope: float = 0.5) -> Array:
    """Return light that decreases to the corners, and from left to right."""
    y, x = np.mgrid[: lens.height, : lens.width]
    r2 = ((x / lens.width - 0.5) ** 2 + (y / lens.height - 0.5) ** 2) / 0.5
    return np.asarray((1 - (1 - corner) * r2) * (1 - slope * x / lens.width))


def rig(*cameras: RigCamera, dictionary: str = "DICT_4X4_100") -> Message:
    """Return a rig with every id."""
    markers = tuple(RigMarker(n) for n in range(600))
    return Message("/rig", 0, 0, Rig("lab", dictionary, 0.2, markers, cameras))


def calibrated(lens: CameraCalibration) -> Message:
    return Message(f"/cameras/{lens.frame_id}/calibration", 0, 0, lens, lens.frame_id)


def frame(data: bytes | RawImage, time_ns: int, camera: str = "red") -> Message:
    """Return a frame as a source delivers it."""
    payload = data if isinstance(data, RawImage) else CompressedImage(time_ns, camera, data, "jpeg")
    return Message(f"/cameras/{camera}/image", time_ns, time_ns, payload, camera)


class Score:
    """The errors of the detected corners, the missed markers and the false markers."""

    def __init__(self) -> None:
        self.offs_px: list[Array] = []
        self.normalized: list[float] = []
        self.edge_offsets_px: list[float] = []
        self.missed: list[tuple[int, int]] = []
        self.wrong: list[int] = []

    def add(self, markers: Sequence[Marker], truth_px: Mapping[int, Array], whole: Iterable[int]) -> None:
        """Compare the detected markers of a frame; ``whole`` markers must be detected."""
        found = {marker.id: marker for marker in markers}
        for marker_id, marker in found.items():
            off_px = marker.corners_px - truth_px.get(marker_id, np.full((4, 2), np.inf))
            if not np.hypot(*off_px.T).mean() < 10:
                self.wrong.append(marker_id)
            elif marker_id in whole:
                self.offs_px.append(off_px)
                self.edge_offsets_px.append(marker.edge_offset_px or 0.0)
                if marker.covariance_px2 is not None:
                    inverse = np.linalg.pinv(marker.covariance_px2, rcond=1e-6, hermitian=True)
                    self.normalized.append(float(off_px.ravel() @ inverse @ off_px.ravel()) / 6)
        self.missed += [(len(self.offs_px), marker_id) for marker_id in whole if marker_id not in found]

    @property
    def rms_px(self) -> float:
        """Return the RMS of the distances in the image plane."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.offs_px), axis=2))))

    @property
    def max_px(self) -> float:
        return float(np.sqrt(np.sum(np.square(self.offs_px), axis=2).max()))

    @property
    def found(self) -> float:
        return len(self.offs_px) / (len(self.offs_px) + len(self.missed))

    def __repr__(self) -> str:
        return (
            f"{len(self.offs_px)} markers, {self.rms_px:.4f} px RMS, {self.max_px:.3f} px at most, "
            f"{100 * self.found:.1f} % found, normalized {np.mean(self.normalized):.2f}, "
            f"edges off {np.mean(self.edge_offsets_px):.3f} +- {np.std(self.edge_offsets_px):.3f} px, "
            f"wrong {self.wrong}"
        )


def detect(
    lens: CameraCalibration,
    data: bytes | RawImage,
    look: Look = Look(),
    *cameras: RigCamera,
) -> tuple[Marker, ...]:
    """Detect the markers in a single frame."""
    return follow(lens, [(1, data)], look, *cameras)[0]


def follow(
    lens: CameraCalibration,
    frames: Iterable[tuple[int, bytes | RawImage]],
    look: Look = Look(),
    *cameras: RigCamera,
) -> list[tuple[Marker, ...]]:
    """Detect the markers in consecutive frames."""
    stage = Detect("edges")
    made = [
        payload
        for message in (
            rig(*cameras, dictionary=look.dictionary),
            calibrated(lens),
            *(frame(data, time_ns, lens.frame_id) for time_ns, data in frames),
        )
        for payload in stage(message)
    ]
    return [payload.markers for payload in made if isinstance(payload, Markers)]


def _draw_print(
    light: Array, lens: CameraCalibration, one: Print, look: Look, rng: np.random.Generator
) -> None:
    around = int(np.ceil(4 * look.psf_px)) + 2
    outline_px = print_px(lens, one, look)
    # The blur is wrong at the edge of the box, so a larger box is drawn and cropped.
    low = np.floor(outline_px.min(axis=0)).astype(int) - around
    high = np.ceil(outline_px.max(axis=0)).astype(int) + around + 1
    first, last = np.maximum(low, 0), np.minimum(high, [lens.width, lens.height])
    if (first >= last).any():
        return
    # Outside the frame, the floor continues.
    x, y = (np.clip(np.arange(low[n] - around, high[n] + around), 0, light.shape[1 - n] - 1) for n in (0, 1))
    mean = _sampled(lens, one, look, low - around, high + around, light[np.ix_(y, x)], rng)
    start, stop = first - low + around, last - low + around
    light[first[1] : last[1], first[0] : last[0]] = mean[start[1] : stop[1], start[0] : stop[0]]


def _sampled(
    lens: CameraCalibration,
    one: Print,
    look: Look,
    low: NDArray[np.int_],
    high: NDArray[np.int_],
    below: Array,
    rng: np.random.Generator,
) -> Array:
    """Return the mean light of the pixels in a box."""
    lights = _lights(one, look)
    places = _on_print(lens, one, low, high, len(_black(look.dictionary, one.id)))
    column, row = ((2 * (part + look.margin_cells) + 1).astype(np.float32) for part in places)
    slopes = [*np.gradient(column), *np.gradient(row)]
    height, width = column.shape
    fine = np.empty((height, SAMPLES, width, SAMPLES), dtype=np.float32)
    for a, b in np.ndindex(SAMPLES, SAMPLES):
        down = (rng.random(row.shape, dtype=np.float32) + a) / SAMPLES - 0.5
        right = (rng.random(row.shape, dtype=np.float32) + b) / SAMPLES - 0.5
        at_row = np.clip(row + slopes[2] * down + slopes[3] * right, 0, len(lights) - 1)
        at_column = np.clip(column + slopes[0] * down + slopes[1] * right, 0, len(lights) - 1)
        met = lights[at_row.astype(np.intp), at_column.astype(np.intp)]
        fine[:, a, :, b] = np.where(np.isnan(met), below, met)
    blurred = fine.reshape(height * SAMPLES, width * SAMPLES)
    if look.psf_px:
        blurred = cv2.GaussianBlur(blurred, (0, 0), look.psf_px * SAMPLES).astype(np.float32)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float64)


def _lights(one: Print, look: Look) -> NDArray[np.float32]:
    """Return the light of a print by half cells, with its margin, and NaN around it."""
    levels = np.where(_black(look.dictionary, one.id), look.black, look.white)
    for cell, level in one.covered.items():
        levels[cell] = level
    halves = levels.repeat(2, axis=0).repeat(2, axis=1)
    padded = np.pad(halves, round(2 * look.margin_cells), constant_values=look.white)
    return np.pad(_light(padded, look), 1, constant_values=np.nan).astype(np.float32)


def _on_print(
    lens: CameraCalibration, one: Print, low: NDArray[np.int_], high: NDArray[np.int_], cells: int
) -> tuple[Array, Array]:
    """Return the positions of the centres of pixels on a print, column and row in cells: (h, w) each."""
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    rays = _rays(lens, np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64))
    rays = np.column_stack([rays, np.ones(len(rays))])
    normal = one.axes[:, 2]
    points = rays * ((normal @ one.centre_m) / (rays @ normal))[:, None] - one.centre_m
    scale = cells / one.length_m
    column, row = cells / 2 + scale * points @ one.axes[:, 0], cells / 2 - scale * points @ one.axes[:, 1]
    return column.reshape(x.shape), row.reshape(x.shape)


def _rays(lens: CameraCalibration, points_px: Array) -> Array:
    """Return (u, v) of pixels by Newton steps with the derivatives of the pinhole camera."""
    if lens.distortion_model == "kannala_brandt":
        rays = cv2.fisheye.undistortPoints(points_px[:, None], lens.K, lens.D)
        return np.asarray(rays, dtype=np.float64).reshape(-1, 2)
    focal, middle = np.diag(lens.K)[:2], lens.K[:2, 2]
    uv = (points_px - middle) / focal
    for _ in range(30):
        off_px = points_px - _project(lens, np.column_stack([uv, np.ones(len(uv))]))
        uv = uv + off_px / focal
    return np.asarray(uv)


def _project(lens: CameraCalibration, points_m: Array) -> Array:
    project = cv2.fisheye.projectPoints if lens.distortion_model == "kannala_brandt" else cv2.projectPoints
    px, _ = project(np.ascontiguousarray(points_m)[:, None], np.zeros(3), np.zeros(3), lens.K, lens.D)
    return np.asarray(px, dtype=np.float64).reshape(-1, 2)


def _black(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Return the black cells of the square, its border included, the top row first."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = known.markerSize + 2
    black: NDArray[np.bool_] = np.asarray(cv2.aruco.generateImageMarker(known, marker_id, cells)) == 0
    return black


def _light(levels: float | Array, look: Look) -> Array:
    return np.asarray(255.0 * (np.asarray(levels) / 255.0) ** look.gamma)


def each_time(count: int, step_ns: int = 33_333_333) -> Iterator[int]:
    """Return frame times at 30 Hz."""
    return (1_000_000_000 + n * step_ns for n in range(count))
