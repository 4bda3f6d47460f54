"""A model of measurements that were entered together, to check each by the others."""

from __future__ import annotations

from collections.abc import Sequence

from ipsys_log.analysis.consistency import FEWEST_POINTS
from ipsys_log.analysis.cross_validation import gather_places, leave_one_out
from ipsys_log.analysis.outliers import find_suspects
from ipsys_log.analysis.tape import Measured, world_point
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import Measurement, Model, Pair, Rig
from ipsys_log.stages.fit import fit_model
from ipsys_log.survey.scene import Sight

__all__ = ["OTHER_ROWS", "fit_neighbours"]

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
