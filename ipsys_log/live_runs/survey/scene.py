"""The scene of a survey: a log or live cameras, and the predictions of its markers."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import Array, CameraPoints, Interval, Markers, Measurement, Model, Pair, Rig
from ipsys_log.models.table import AppliedModel, reads_corners
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.statistics.consistency import FEWEST_POINTS
from ipsys_log.statistics.cross_validation import gather_points, leave_one_out
from ipsys_log.statistics.outliers import find_outliers
from ipsys_log.statistics.stationary import FEWEST_FRAMES, is_near, is_stationary
from ipsys_log.statistics.tape import RiggedMeasurement, world_point


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The position of a marker by the model of one camera.

    ``world_m`` (3,) is the predicted position, and ``off_m`` its distance from the tape point. ``sigma_m``
    is the model's largest standard deviation in any direction. ``inside`` tells whether the position lies
    between the points of the fit. ``sigma_m`` and ``inside`` are None if the model does not give them.
    """

    camera: str
    world_m: Array
    off_m: float
    sigma_m: float | None
    inside: bool | None


def predict(model: Model, points_m: Mapping[str, Array], world_m: Array) -> tuple[Prediction, ...]:
    """Predict the position of a marker, for each camera that saw it.

    Parameters
    ----------
    model : model from a log.
    points_m : mean camera point (3,) by camera.
    world_m : position (3,) by tape and ruler; models that need the height of the marker use its height.
    """
    applied = _applied(model)
    heights_m = np.array([world_m[2]])
    predictions = []
    for camera, point_m in sorted(points_m.items()):
        if camera not in applied:
            continue
        camera_model, camera_m = applied[camera], point_m[None]
        predicted_m = camera_model.predict(camera_m, heights_m)
        if not np.isfinite(predicted_m).all():
            continue
        covariances_m2 = camera_model.covariances(camera_m, heights_m)
        sigma_m = None
        if covariances_m2 is not None:
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariances_m2[0])[-1]))
        sigmas_m = np.zeros(1) if covariances_m2 is None else np.sqrt(covariances_m2[:, 2, 2])
        inside = camera_model.inside(camera_m, predicted_m, sigmas_m)
        off_m = float(np.linalg.norm(predicted_m[0] - world_m))
        predictions.append(
            Prediction(camera, predicted_m[0], off_m, sigma_m, None if inside is None else bool(inside[0]))
        )
    return tuple(predictions)


@lru_cache(maxsize=2)
def _applied(model: Model) -> dict[str, AppliedModel]:
    # A model of corners cannot predict a point from camera points: it checks no entry.
    if reads_corners(model.name):
        return {}
    return {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """The view of one camera.

    ``jpeg`` is the image taken at ``time_ns``; None without an image. ``markers`` are the markers detected in
    it. ``points`` are the camera points of the last second; those of the image come last. In a finished log,
    they are the camera points of the whole stationary interval. ``measured`` are the calibration points
    measured while the camera was live: id, marker and mean camera point (3,). For a finished log, it is
    empty, because the stationary intervals give the same information.
    """

    camera: str
    time_ns: int
    jpeg: bytes | None = None
    markers: Markers | None = None
    points: tuple[CameraPoints, ...] = ()
    measured: tuple[tuple[str, int, Array], ...] = ()


@dataclass(frozen=True, slots=True)
class StationaryInterval:
    """A stationary interval of a marker in a finished log; both ends belong to it."""

    marker_id: int
    start_ns: int
    end_ns: int
    cameras: tuple[str, ...]

    def covers(self, measurement: Measurement) -> bool:
        """Return whether a measurement belongs to this marker and this stationary interval."""
        still = measurement.still or Interval(measurement.timestamp, measurement.timestamp)
        overlaps = still.start <= self.end_ns and still.end >= self.start_ns
        return measurement.marker_id == self.marker_id and overlaps


class MeasuringScene(Protocol):
    """The source of views for measuring: a finished log or live cameras.

    ``intervals`` are the stationary intervals of a finished log, in order; empty during a recording.
    ``model`` and ``rig`` are the present ones. All calls must come from one thread; this can be any thread.
    """

    @property
    def rig(self) -> Rig: ...

    @property
    def model(self) -> Model | None: ...

    @property
    def intervals(self) -> Sequence[StationaryInterval]: ...

    def views(self, interval: int | None) -> Sequence[CameraView]:
        """Return the latest view of every camera, or the views of a stationary interval by its index."""
        ...

    def history(self) -> Sequence[Measurement]:
        """Return every measurement and withdrawal so far, in the order of their creation."""
        ...

    def add(self, measurements: Sequence[Measurement]) -> None:
        """Append measurements or withdrawals: all of them, or none and an error."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class MarkerObservations:
    """The observations of one marker by all cameras.

    ``still`` is its stationary interval; None if it moves or is not seen. ``points_m`` are its mean camera
    points (3,) in this interval, by camera. ``moving`` are the cameras that see it move. ``measured_as`` are
    the measurements of the marker at its present position, by the views of all cameras.
    """

    marker_id: int
    still: Interval | None
    points_m: Mapping[str, Array]
    moving: tuple[str, ...] = ()
    measured_as: tuple[str, ...] = ()

    @property
    def state(self) -> str:
        """The state: ``still``, ``moving`` or ``unseen``."""
        if self.moving:
            return "moving"
        return "unseen" if self.still is None else "still"

    @property
    def text(self) -> str:
        """The state as a sentence."""
        name = f"marker {self.marker_id}"
        if self.moving:
            return f"{name} moves, as seen by {', '.join(self.moving)}: wait until it stops"
        if self.still is None:
            return f"no camera sees {name}: step out of the view, and check that the marker faces up"
        return f"{name} is stationary, seen by {', '.join(self.points_m)}"


def observe_marker(views: Sequence[CameraView], marker_id: int) -> MarkerObservations:
    """Combine the observations of a marker by all cameras; check whether the marker is stationary.

    Examples
    --------
    >>> from ipsys_log.messages import CameraPoint
    >>> seen = tuple(CameraPoints(n, (CameraPoint(7, 0.1, 0.2, 2.0),)) for n in (100, 200, 300))
    >>> sight = observe_marker([CameraView("red", 300, points=seen), CameraView("white", 300)], 7)
    >>> sight.text == "marker 7 is stationary, seen by red"
    True
    """
    seen: dict[str, tuple[int, int, Array]] = {}
    moving = []
    for view in views:
        rows = [(p.timestamp, point) for p in view.points for point in p.points if point.id == marker_id]
        if len(rows) < FEWEST_FRAMES:
            continue
        seen_m = np.array([(point.x_m, point.y_m, point.z_m) for _, point in rows])
        if not is_stationary(seen_m):
            moving.append(view.camera)
        times_ns = [time_ns + (point.time_offset_ns or 0) for time_ns, point in rows]
        seen[view.camera] = min(times_ns), max(times_ns), seen_m.mean(axis=0)
    if moving or not seen:
        return MarkerObservations(marker_id, None, {}, tuple(moving))
    # The last view of a camera may end before another camera sees the marker. Then the marker may have been
    # at another position, so this camera is left out.
    start_ns = end_ns = max(last_ns for _, last_ns, _ in seen.values())
    for first_ns, last_ns, _ in sorted(seen.values(), key=lambda one: one[1], reverse=True):
        if last_ns >= start_ns:
            start_ns = min(start_ns, first_ns)
    points_m = {camera: mean_m for camera, (_, last_ns, mean_m) in seen.items() if last_ns >= start_ns}
    measured_as = _measured_as(views, marker_id, points_m)
    return MarkerObservations(marker_id, Interval(start_ns, end_ns), points_m, measured_as=measured_as)


def _measured_as(
    views: Iterable[CameraView], marker_id: int, points_m: Mapping[str, Array]
) -> tuple[str, ...]:
    """Return the ids of the measurements of a marker at its present position, by all cameras with data."""
    same: dict[str, bool] = {}
    for view in views:
        present_m = points_m.get(view.camera)
        for name, measured_id, measured_m in view.measured:
            if measured_id == marker_id and present_m is not None:
                same[name] = same.get(name, True) and bool(is_near(present_m[None], measured_m)[0])
    return tuple(name for name, is_same in same.items() if is_same)


def visible_markers(views: Iterable[CameraView], rig: Rig) -> list[int]:
    """Return the ids of the rig's markers that at least one camera sees, sorted."""
    ids = {point.id for view in views for points in view.points for point in points.points}
    return sorted(marker_id for marker_id in ids if rig.knows(marker_id))


# The name of a model that is fitted to the rows of a sheet, in a warning.
OTHER_ROWS = "the other rows"
# The fit takes milliseconds. It follows the points closely enough to show an error of some centimetres.
_MODEL = "poly"


def fit_neighbours(seen: Sequence[tuple[Measurement, MarkerObservations]], rig: Rig) -> Model | None:
    """Fit a model to measurements, without the measurements that contradict the rest.

    Parameters
    ----------
    seen : measurements, each with the observations of its marker.
    rig : rig of all measurements.

    Returns
    -------
    The model; None if no camera saw enough calibration points.
    """
    pairs = _pairs(seen, rig)
    if not pairs:
        return None
    places = [RiggedMeasurement(measurement, rig) for measurement, _ in seen]
    paired_ids = {pair.measurement for camera_pairs in pairs.values() for pair in camera_pairs}
    try:
        suspects = find_outliers(
            leave_one_out(_MODEL, gather_points(pairs)),
            [place for place in places if place.measurement.id in paired_ids],
        )
        suspect_ids = {suspect.measurement for suspect in suspects}
        kept = {
            camera: [p for p in camera_pairs if p.measurement not in suspect_ids]
            for camera, camera_pairs in pairs.items()
        }
        return fit_model(
            _MODEL,
            {
                camera: camera_pairs
                for camera, camera_pairs in kept.items()
                if len(camera_pairs) >= FEWEST_POINTS
            },
            0,
        )
    except FitError:
        return None


def _pairs(seen: Sequence[tuple[Measurement, MarkerObservations]], rig: Rig) -> dict[str, list[Pair]]:
    """Pair camera points and world points, by camera; a camera with too few pairs is left out."""
    pairs: dict[str, list[Pair]] = {}
    for measurement, observations in seen:
        try:
            fixed = world_point(measurement, rig)
        except IpsysError:
            continue
        for camera, point_m in observations.points_m.items():
            row = (measurement.id, observations.marker_id, point_m, fixed.world_m, 1, fixed.covariance_m2)
            pairs.setdefault(camera, []).append(Pair(*row))
    return {
        camera: camera_pairs for camera, camera_pairs in pairs.items() if len(camera_pairs) >= FEWEST_POINTS
    }
