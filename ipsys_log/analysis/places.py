"""Measured places as they are drawn: where they are, and what they are for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.pairs import active_measurements
from ipsys_log.analysis.tape import world_point
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Measurement, Rig

__all__ = ["KINDS", "Place", "measured_places"]

KINDS = ("training", "test", "measured")


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """``point_m`` (3,) in the world; ``kind`` is ``measured`` where nothing says what it is for."""

    id: str
    point_m: NDArray[np.float64]
    kind: str


def measured_places(measurements: Iterable[Measurement], rig: Rig | None) -> tuple[list[Place], list[str]]:
    """The places that count, and what is wrong with those that cannot be drawn.

    To look at a log must be possible above all when something in it is wrong: what the stages
    refuse is left out here, and said.

    Parameters
    ----------
    measurements : in the order they were made.
    rig : for the reference points; without one only places with a world point can be drawn.
    """
    try:
        active = active_measurements(measurements)
    except IpsysError as error:
        return [], [str(error)]
    places, faults = [], []
    for measurement in active:
        if rig is None and measurement.point is None:
            faults.append(f"measurement {measurement.id} cannot be placed: the log has no rig")
            continue
        try:
            # The rig is not looked at where the measurement has its point.
            point_m = world_point(measurement, rig or Rig("", "", 1.0)).world_m
        except IpsysError as error:
            faults.append(str(error))
            continue
        places.append(Place(measurement.id, point_m, _kind(measurement)))
    return places, faults


def _kind(measurement: Measurement) -> str:
    if "test" in measurement.splits:
        return "test"
    return "training" if measurement.splits else "measured"
