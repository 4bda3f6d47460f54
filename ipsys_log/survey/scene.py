"""The scene of a survey: a log or live cameras, and the predictions of its markers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.consistency import FEWEST_POINTS
from ipsys_log.analysis.cross_validation import gather_places, leave_one_out
from ipsys_log.analysis.outliers import find_suspects
from ipsys_log.analysis.stationary import FEWEST_FRAMES, lies_at, lies_still
from ipsys_log.analysis.tape import Measured, world_point
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import CameraPoints, Interval, Markers, Measurement, Model, Pair, Rig
from ipsys_log.models.table import AppliedModel
from ipsys_log.stages.fit import fit_model

__all__ = [
    "OTHER_ROWS",
    "Prediction",
    "Scene",
    "Sight",
    "Stop",
    "View",
    "fit_neighbours",
    "look",
    "predict",
    "visible_markers",
]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the model of a camera has the marker, ``world_m`` (3,), and ``off_m`` how far from the tape.

    ``sigma_m`` is the model's own in the worst direction, ``inside`` whether the place lies among those
    that it was fitted to; None where the model does not say.
    """

    camera: str
    world_m: Array
    off_m: float
    sigma_m: float | None
    inside: bool | None


def predict(model: Model, points_m: Mapping[str, Array], world_m: Array) -> tuple[Prediction, ...]:
    """What the model of each camera that saw the marker says.

    Parameters
    ----------
    model : out of a log.
    points_m : mean camera point (3,) by camera.
    world_m : (3,), by tape and ruler; models that need the height of the marker get it from here.
    """
    applied = _applied(model)
    heights_m = np.array([world_m[2]])
    found = []
    for camera, point_m in sorted(points_m.items()):
        if camera not in applied:
            continue
        one, here_m = applied[camera], point_m[None]
        there_m = one.predict(here_m, heights_m)
        if not np.isfinite(there_m).all():
            continue
        covariances_m2 = one.covariances(here_m, heights_m)
        sigma_m = None
        if covariances_m2 is not None:
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariances_m2[0])[-1]))
        sigmas_m = np.zeros(1) if covariances_m2 is None else np.sqrt(covariances_m2[:, 2, 2])
        inside = one.inside(here_m, there_m, sigmas_m)
        off_m = float(np.linalg.norm(there_m[0] - world_m))
        found.append(
            Prediction(camera, there_m[0], off_m, sigma_m, None if inside is None else bool(inside[0]))
        )
    return tuple(found)


@lru_cache(maxsize=2)
def _applied(model: Model) -> dict[str, AppliedModel]:
    return {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a camera sees.

    ``jpeg`` is the picture taken at ``time_ns``, None where there is none, and ``markers`` those found in
    it. ``points`` are the camera points of the last second, that picture's last; of a finished log those
    of the whole stretch in which the marker lies still. ``measured`` are the places measured so far while
    the camera sent: id, marker and mean camera point (3,); of a finished log none, its stretches tell.
    """

    camera: str
    time_ns: int
    jpeg: bytes | None = None
    markers: Markers | None = None
    points: tuple[CameraPoints, ...] = ()
    measured: tuple[tuple[str, int, Array], ...] = ()


@dataclass(frozen=True, slots=True)
class Stop:
    """A stretch of a finished log, ends included, in which a marker lies still."""

    marker_id: int
    start_ns: int
    end_ns: int
    cameras: tuple[str, ...]

    def covers(self, measurement: Measurement) -> bool:
        """Whether a measurement is one of this marker in this stretch."""
        still = measurement.still or Interval(measurement.timestamp, measurement.timestamp)
        here = still.start <= self.end_ns and still.end >= self.start_ns
        return measurement.marker_id == self.marker_id and here


class Scene(Protocol):
    """What measuring is done on.

    ``stops`` are the places of a finished log, in order; none while recording. ``model`` is the present
    one, ``rig`` the one that holds. Whoever asks does so from one thread, which need not be the main one.
    """

    @property
    def rig(self) -> Rig: ...

    @property
    def model(self) -> Model | None: ...

    @property
    def stops(self) -> Sequence[Stop]: ...

    def views(self, stop: int | None) -> Sequence[View]:
        """The latest view of every camera, or the views of a stop by its index."""
        ...

    def history(self) -> Sequence[Measurement]:
        """Every measurement and withdrawal so far, in the order they were made."""
        ...

    def add(self, measurements: Sequence[Measurement]) -> None:
        """Append measurements or withdrawals: all of them, or none and an error."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What the cameras say of one marker.

    ``still`` is the stretch in which it lies still, None where it moves or is not seen; ``points_m`` its
    mean camera point (3,) by camera then; ``moving`` are the cameras that see it move;
    ``measured_as`` are the measurements since which every camera sees it where it was.
    """

    marker_id: int
    still: Interval | None
    points_m: Mapping[str, Array]
    moving: tuple[str, ...] = ()
    measured_as: tuple[str, ...] = ()

    @property
    def state(self) -> str:
        """``still``, ``moving`` or ``unseen``."""
        if self.moving:
            return "moving"
        return "unseen" if self.still is None else "still"

    @property
    def text(self) -> str:
        """The state in words."""
        name = f"marker {self.marker_id}"
        if self.moving:
            return f"{name} moves, as seen by {', '.join(self.moving)}: wait until it lies still"
        if self.still is None:
            return f"no camera sees {name}: step back, turn it face up"
        return f"{name} lies still, seen by {', '.join(self.points_m)}"


def look(views: Sequence[View], marker_id: int) -> Sight:
    """What the cameras say of a marker: whether it lies still, and where.

    Examples
    --------
    >>> from ipsys_log.messages import CameraPoint
    >>> seen = tuple(CameraPoints(n, (CameraPoint(7, 0.1, 0.2, 2.0),)) for n in (100, 200, 300))
    >>> look([View("red", 300, points=seen), View("white", 300)], 7).text
    'marker 7 lies still, seen by red'
    """
    seen: dict[str, tuple[int, int, Array]] = {}
    moving = []
    for view in views:
        rows = [(p.timestamp, one) for p in view.points for one in p.points if one.id == marker_id]
        if len(rows) < FEWEST_FRAMES:
            continue
        seen_m = np.array([(one.x_m, one.y_m, one.z_m) for _, one in rows])
        if not lies_still(seen_m):
            moving.append(view.camera)
        times_ns = [time_ns + (one.time_offset_ns or 0) for time_ns, one in rows]
        seen[view.camera] = min(times_ns), max(times_ns), seen_m.mean(axis=0)
    if moving or not seen:
        return Sight(marker_id, None, {}, tuple(moving))
    # A camera that sees it no more since before another one did may have seen it elsewhere.
    start_ns = end_ns = max(last_ns for _, last_ns, _ in seen.values())
    for first_ns, last_ns, _ in sorted(seen.values(), key=lambda one: one[1], reverse=True):
        if last_ns >= start_ns:
            start_ns = min(start_ns, first_ns)
    points_m = {camera: mean_m for camera, (_, last_ns, mean_m) in seen.items() if last_ns >= start_ns}
    measured_as = _measured_as(views, marker_id, points_m)
    return Sight(marker_id, Interval(start_ns, end_ns), points_m, measured_as=measured_as)


def _measured_as(views: Iterable[View], marker_id: int, points_m: Mapping[str, Array]) -> tuple[str, ...]:
    """The measurements of a marker made where it is now, for all cameras that can tell."""
    same: dict[str, bool] = {}
    for view in views:
        here_m = points_m.get(view.camera)
        for name, measured_id, there_m in view.measured:
            if measured_id == marker_id and here_m is not None:
                same[name] = same.get(name, True) and bool(lies_at(here_m[None], there_m)[0])
    return tuple(name for name, is_same in same.items() if is_same)


def visible_markers(views: Iterable[View], rig: Rig) -> list[int]:
    """The rig's markers that some camera sees, sorted."""
    found = {point.id for view in views for points in view.points for point in points.points}
    return sorted(one for one in found if rig.knows(one))


# Their name in a warning.
OTHER_ROWS = "the other rows"
# Fits in milliseconds, and follows the points closely enough to see an error of some centimetres.
_MODEL = "poly"


def fit_neighbours(seen: Sequence[tuple[Measurement, Sight]], rig: Rig) -> Model | None:
    """Fit a model to measurements, without those that contradict the rest.

    Parameters
    ----------
    seen : measurements, each with the observations of its marker.
    rig : of all of them.

    Returns
    -------
    None if no camera saw enough of them.
    """
    pairs = _pairs(seen, rig)
    if not pairs:
        return None
    places = [Measured(measurement, rig) for measurement, _ in seen]
    within = {pair.measurement for held in pairs.values() for pair in held}
    try:
        suspects = find_suspects(
            leave_one_out(_MODEL, gather_places(pairs)),
            [place for place in places if place.measurement.id in within],
        )
        wrong = {suspect.measurement for suspect in suspects}
        kept = {camera: [p for p in held if p.measurement not in wrong] for camera, held in pairs.items()}
        return fit_model(
            _MODEL, {camera: held for camera, held in kept.items() if len(held) >= FEWEST_POINTS}, 0
        )
    except FitError:
        return None


def _pairs(seen: Sequence[tuple[Measurement, Sight]], rig: Rig) -> dict[str, list[Pair]]:
    """Pair camera points and world points, by camera; a camera with few of them is left out."""
    pairs: dict[str, list[Pair]] = {}
    for measurement, sight in seen:
        try:
            fixed = world_point(measurement, rig)
        except IpsysError:
            continue
        for camera, point_m in sight.points_m.items():
            row = (measurement.id, sight.marker_id, point_m, fixed.world_m, 1, fixed.covariance_m2)
            pairs.setdefault(camera, []).append(Pair(*row))
    return {camera: held for camera, held in pairs.items() if len(held) >= FEWEST_POINTS}
