"""Observations of a lab as arrays: cameras, bodies, calibration points, and sightings; and parts of them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.lens_models import LENS_MODELS, LensModel
from ipsys_log.messages import Array, CameraCalibration, Indices
from ipsys_log.vision.markers import marker_corners

# In a lab with so few cameras, a robot passes all of them within seconds.
_FEW_CAMERAS = 8
_MODELS = {
    model.distortion_model: model
    for model in (LENS_MODELS["fisheye"], LENS_MODELS["pinhole"], LENS_MODELS["pinhole8"])
}


def lens_model_of(lens: CameraCalibration) -> LensModel:
    """Return the lens model of a calibration."""
    return _MODELS[lens.distortion_model]


@dataclass(frozen=True, slots=True, eq=False)
class CameraPrior:
    """A camera before the fit: its name and its intrinsics.

    ``nominal`` intrinsics come from a data sheet and not from a chessboard. ``row_time_s`` None: the time
    between two rows is unknown, and the fit estimates it. ``known_row_s`` is the part that the times of the
    sightings contain. ``is_former`` marks the observations of a camera before it was moved.
    """

    name: str
    lens: CameraCalibration
    nominal: bool = False
    row_time_s: float | None = 0.0
    known_row_s: float = 0.0
    is_former: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A rigid set of points, such as the corners of a marker or of a board.

    ``points_m`` (p, 3) are the nominal positions. The fit estimates one scale factor, with the prior
    standard deviation ``scale_sigma``; infinity if the size is unknown. ``height_m`` is the height at which
    a robot carries the body, with its standard deviation.
    """

    name: str
    points_m: Array
    scale_sigma: float
    height_m: float | None = None
    height_sigma_m: float = 0.001

    @property
    def length_m(self) -> float:
        """The nominal distance of its first two points."""
        return float(np.linalg.norm(self.points_m[1] - self.points_m[0]))


def marker_body(
    name: str,
    length_m: float,
    scale_sigma: float,
    height_m: float | None = None,
    height_sigma_m: float = 0.001,
) -> Body:
    """Return the body of a marker with a side of ``length_m``: its four corners, in OpenCV's order."""
    return Body(name, marker_corners(length_m), scale_sigma, height_m, height_sigma_m)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPoint:
    """A place where a body was stationary, with everything that was measured there.

    ``distances_m`` (k,) with ``distance_sigmas_m`` (k,) are tape distances from ``references_m`` (k, 2), in
    the plane of the floor. ``start_m`` (2,) is a rough position, from these distances. ``point_m`` (2,) with
    ``covariance_m2`` (2, 2) is a given world point; ``on_reference``: it is a reference point of the rig.
    ``height_m`` is the height above the floor.
    """

    name: str
    body: int
    references_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    distances_m: Array = field(default_factory=lambda: np.zeros(0))
    distance_sigmas_m: Array = field(default_factory=lambda: np.zeros(0))
    start_m: Array | None = None
    point_m: Array | None = None
    covariance_m2: Array | None = None
    height_m: float | None = None
    height_sigma_m: float = 0.001
    on_reference: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Tape:
    """The tape of a lab, and the coordinates of the reference points from which it measures.

    Attributes
    ----------
    scale_sigma : relative error of all its readings together.
    references_sigma : relative error of the distances between the reference points in the rig. If the rig
        does not name another instrument, a tape has measured them, too.
    middle_m : (2,), the middle of the reference points, which this error does not move.
    baselines_m, readings_m, reading_sigmas_m : (k,), distances of two reference points in the rig, and the
        readings of these distances with this tape.
    """

    scale_sigma: float = 0.001
    references_sigma: float = 0.001
    middle_m: Array = field(default_factory=lambda: np.zeros(2))
    baselines_m: Array = field(default_factory=lambda: np.zeros(0))
    readings_m: Array = field(default_factory=lambda: np.zeros(0))
    reading_sigmas_m: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Sightings of bodies with p points each by one camera.

    Attributes
    ----------
    body : (n,), indices of bodies.
    point : (n,), indices of the calibration points at which the bodies are stationary; -1: the body moves.
    times_s : (n,), instants of exposure by the camera's own clock.
    pixels : (n, p, 2), in px of the raw image; NaN for a point that is not visible.
    covariances_px2 : (n, 2 p, 2 p), of x0 y0 x1 y1 ...; without correlation with points that are not visible.
    """

    body: Indices
    point: Indices
    times_s: Array
    pixels: Array
    covariances_px2: Array

    def __len__(self) -> int:
        return len(self.body)

    def select(self, mask: NDArray[np.bool_] | Indices) -> Sightings:
        """Return some of the sightings, by a mask (n,) or by indices."""
        return Sightings(
            self.body[mask],
            self.point[mask],
            self.times_s[mask],
            self.pixels[mask],
            self.covariances_px2[mask],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Everything that was observed in a lab; ``sightings`` has one entry for each camera.

    At each time of ``restarts_s`` (r,), another recording of moving bodies begins. Its clocks have other
    offsets.
    """

    cameras: tuple[CameraPrior, ...]
    bodies: tuple[Body, ...]
    points: tuple[CalibrationPoint, ...]
    sightings: tuple[Sightings, ...]
    tape: Tape = Tape()
    restarts_s: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def in_hall(self) -> bool:
        """True with so many cameras that most of them never see the same place."""
        return len(self.cameras) > _FEW_CAMERAS

    def recording_of(self, sightings: Sightings) -> Indices:
        """Return the number (n,) of the recording of each sighting; bodies at rest are in the last one."""
        numbers = np.searchsorted(self.restarts_s, sightings.times_s, side="right")
        return np.where(sightings.point < 0, numbers, len(self.restarts_s))


def without_points(observations: Observations, names: Collection[str]) -> Observations:
    """Return the observations without some calibration points, and without their sightings."""
    kept = [number for number, point in enumerate(observations.points) if point.name not in names]
    # The last entry is that of moving bodies, -1.
    numbers = np.full(len(observations.points) + 1, -1, dtype=np.intp)
    numbers[kept] = np.arange(len(kept))
    dropped = np.array([point.name in names for point in observations.points] + [False], dtype=np.bool_)
    selected = []
    for sightings in observations.sightings:
        rest = sightings.select(~dropped[sightings.point])
        selected.append(replace(rest, point=numbers[rest.point]))
    points = tuple(observations.points[number] for number in kept)
    return replace(observations, points=points, sightings=tuple(selected))


def without_cameras(observations: Observations, cameras: Collection[int]) -> Observations:
    """Return the observations without some cameras, by their numbers."""
    kept = [number for number in range(len(observations.cameras)) if number not in cameras]
    return replace(
        observations,
        cameras=tuple(observations.cameras[number] for number in kept),
        sightings=tuple(observations.sightings[number] for number in kept),
    )


def seeing_cameras(observations: Observations) -> Observations:
    """Return the observations of the cameras that have sightings."""
    blind = [number for number, sightings in enumerate(observations.sightings) if not len(sightings)]
    return without_cameras(observations, blind)


def divide_camera(observations: Observations, camera: int, time_s: float) -> Observations:
    """Return observations in which a camera until a time is another one, after all others."""
    prior, sightings = observations.cameras[camera], observations.sightings[camera]
    before = sightings.times_s <= time_s
    later = [*observations.sightings]
    later[camera] = sightings.select(~before)
    return replace(
        observations,
        cameras=(*observations.cameras, replace(prior, is_former=True)),
        sightings=(*later, sightings.select(before)),
    )
