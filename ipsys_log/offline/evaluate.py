"""How far a model is off on places that it was not fitted on (eq. 26, 27)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import (
    CameraEvaluation,
    ErrorStatistics,
    Evaluation,
    Message,
    Model,
    Pair,
    Residual,
    Tracks,
)
from ipsys_log.models import restore
from ipsys_log.offline.pairs import Measured, Sightings, still_interval

__all__ = ["error_statistics", "evaluate_model", "gather_tracks", "track_errors", "true_points"]


def error_statistics(errors_m: NDArray[np.float64]) -> ErrorStatistics:
    """Mean, lower bound, upper bound and standard deviation of distances.

    Parameters
    ----------
    errors_m : (n,), n > 0, in m.

    References
    ----------
    Ou et al., Robotica 2023, Tables I and II; the standard deviation there has n - 1.

    Examples
    --------
    >>> error_statistics(np.array([0.01, 0.03])).mean_m
    0.02
    """
    count = len(errors_m)
    std_m = float(errors_m.std(ddof=1)) if count > 1 else None
    return ErrorStatistics(count, float(errors_m.mean()), float(errors_m.min()), float(errors_m.max()), std_m)


def evaluate_model(
    model: Model,
    held_out: Mapping[str, Sequence[Pair]],
    truth: Mapping[str, NDArray[np.float64]],
    time_ns: int,
) -> Evaluation:
    """Errors of a model on held-out places, against the tape and, where there is one, the truth.

    Parameters
    ----------
    model : fitted.
    held_out : measured places by camera; those that the model was fitted on after all do not count.
    truth : true world points (3,) in m by id of the measurement; empty outside a simulated lab.
    time_ns : of the last input.

    Returns
    -------
    Evaluation : with a row for each camera that has held-out places.
    """
    rows = []
    for camera in model.cameras:
        used = {pair.measurement: pair.world_m for pair in camera.pairs}
        pairs = [
            pair
            for pair in held_out.get(camera.camera, ())
            if not np.array_equal(used.get(pair.measurement, ()), pair.world_m)
        ]
        if not pairs:
            continue
        estimator = restore(model.name, {p.name: p.values.reshape(p.shape) for p in camera.parameters})
        predicted_m = estimator.predict(np.array([pair.camera_m for pair in pairs]))
        tape = {pair.measurement: pair.world_m for pair in pairs}
        for against, known in (("tape", tape), ("truth", truth)):
            row = _compare(camera.camera, against, pairs, predicted_m, known)
            if row is not None:
                rows.append(row)
    return Evaluation(time_ns, model.name, tuple(rows))


def _compare(
    camera: str,
    against: str,
    pairs: Sequence[Pair],
    predicted_m: NDArray[np.float64],
    known: Mapping[str, NDArray[np.float64]],
) -> CameraEvaluation | None:
    residuals = tuple(
        Residual(pair.measurement, known[pair.measurement], predicted)
        for pair, predicted in zip(pairs, predicted_m, strict=True)
        if pair.measurement in known
    )
    if not residuals:
        return None
    offsets = np.array([r.predicted_m - r.world_m for r in residuals])
    error_3d = error_statistics(np.linalg.norm(offsets, axis=1))  # eq. (26)
    error_2d = error_statistics(np.linalg.norm(offsets[:, :2], axis=1))  # eq. (27)
    return CameraEvaluation(camera, against, error_3d, error_2d, residuals)


def gather_tracks(messages: Iterable[Message]) -> dict[int, Sightings]:
    """Positions of tracks by marker, in the order of time and, at one time, of the log."""
    rows: dict[int, list[tuple[int, float, float, float]]] = {}
    for message in messages:
        if isinstance(message.payload, Tracks):
            for track in message.payload.tracks:
                row = (message.publish_time_ns, track.x_m, track.y_m, track.z_m)
                rows.setdefault(track.id, []).append(row)
    for values in rows.values():
        values.sort(key=lambda row: row[0])
    return {
        marker_id: Sightings(
            np.array([row[0] for row in values], dtype=np.int64),
            np.array([row[1:] for row in values], dtype=np.float64),
        )
        for marker_id, values in rows.items()
    }


def true_points(places: Iterable[Measured], truth: Mapping[int, Sightings]) -> dict[str, NDArray[np.float64]]:
    """Where each measured marker truly was, (3,) in m by id; only where the truth of that time is known."""
    points = {}
    for place in places:
        measurement = place.measurement
        known = truth.get(measurement.marker_id if measurement.marker_id is not None else -1)
        if known is not None and (interval := still_interval(known, measurement.timestamp)) is not None:
            within = (known.times_ns >= interval[0]) & (known.times_ns <= interval[1])
            points[measurement.id] = known.points_m[within].mean(axis=0)
    return points


def track_errors(
    tracks: Mapping[int, Sightings], truth: Mapping[int, Sightings]
) -> tuple[ErrorStatistics, ErrorStatistics] | None:
    """Errors of tracks against the truth at the same instants, in space and on the floor.

    Returns
    -------
    None where no instant of a track has a truth.
    """
    offsets = []
    for marker_id, track in tracks.items():
        known = truth.get(marker_id)
        if known is None:
            continue
        # The last of the poses of one instant rests on all cameras.
        times_ns, last = np.unique(track.times_ns[::-1], return_index=True)
        common, here, there = np.intersect1d(times_ns, known.times_ns, return_indices=True)
        if len(common):
            offsets.append(track.points_m[::-1][last][here] - known.points_m[there])
    if not offsets:
        return None
    rows = np.vstack(offsets)
    return error_statistics(np.linalg.norm(rows, axis=1)), error_statistics(
        np.linalg.norm(rows[:, :2], axis=1)
    )
