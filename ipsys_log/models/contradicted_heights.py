"""Reports of markers whose images contradict the heights of the rig: one event for each marker."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from ipsys_log.messages import Array, Event, Model
from ipsys_log.messages.events import CONTRADICTED_HEIGHT
from ipsys_log.units import NS_PER_S

# A calibration point has its own height, which is not that of a marker on its robot.
_SAME_POINT_M = 0.05
# This many successive sightings must agree in the height. A marker that is carried by hand does not.
_LEAST_SIGHTINGS = 10
_MOST_SIGMAS = 4.0
# In a log with calibration points of the marker, further points may follow that are not in the model. There,
# only a marker in motion counts: this length of its path, in steps of a robot.
_LEAST_PATH_M = 0.3
_LONGEST_STEP_NS, _STEPS_M = NS_PER_S, (0.003, 0.5)
# In other logs, so many places, and their least distance.
_LEAST_PLACES, _OTHER_PLACE_M = 3, 0.2


@dataclass(frozen=True, slots=True, eq=False)
class HeightSighting:
    """A marker whose image contradicts its height ``stated_m``.

    ``point_m`` (3,) is its point by the image alone; ``above_m`` is the height of this point above the floor,
    with the standard deviation ``sigma_m``.
    """

    marker_id: int
    stated_m: float
    point_m: Array
    above_m: float
    sigma_m: float


@dataclass(slots=True, eq=False)
class _Evidence:
    """Sightings of a marker that agree: heights, places (2,), the length of the path, and the last place."""

    heights_m: list[float] = field(default_factory=list)
    places_m: list[Array] = field(default_factory=list)
    path_m: float = 0.0
    last: tuple[int, Array] | None = None

    def add(self, time_ns: int, sighting: HeightSighting) -> None:
        place_m = sighting.point_m[:2]
        if self.last is not None:
            step_m = float(np.linalg.norm(place_m - self.last[1]))
            is_step = time_ns - self.last[0] <= _LONGEST_STEP_NS and _STEPS_M[0] <= step_m <= _STEPS_M[1]
            self.path_m += step_m if is_step else 0.0
        self.last = time_ns, place_m
        self.heights_m.append(sighting.above_m)
        if all(np.linalg.norm(place_m - other_m) > _OTHER_PLACE_M for other_m in self.places_m):
            self.places_m.append(place_m)


class ContradictedHeights:
    """The memory of contradicted heights; it reports each marker once, when enough sightings agree.

    Parameters
    ----------
    model : its calibration points are not reported.
    """

    def __init__(self, model: Model) -> None:
        self._points_m: dict[int, list[Array]] = {}
        for camera in model.cameras:
            for pair in camera.pairs:
                self._points_m.setdefault(pair.marker_id, []).append(np.array(pair.world_m))
        self._at_points: set[int] = set()
        self._said: set[int] = set()
        self._evidence: dict[int, _Evidence] = {}

    def __call__(
        self, time_ns: int, camera: str | None, sightings: Iterable[HeightSighting]
    ) -> Iterator[Event]:
        """Yield an event for each marker whose contradicted height is certain with these sightings."""
        for sighting in sightings:
            marker_id = sighting.marker_id
            if marker_id in self._said:
                continue
            if self._is_at_point(sighting):
                self._at_points.add(marker_id)
                continue
            evidence = self._evidence.setdefault(marker_id, _Evidence())
            heights_m = evidence.heights_m
            if heights_m and abs(sighting.above_m - median(heights_m)) > _MOST_SIGMAS * sighting.sigma_m:
                evidence = self._evidence[marker_id] = _Evidence()
            evidence.add(time_ns, sighting)
            if self._is_certain(marker_id, evidence):
                self._said.add(marker_id)
                yield Event(time_ns, CONTRADICTED_HEIGHT, _text(sighting, evidence), camera, marker_id)

    def _is_at_point(self, sighting: HeightSighting) -> bool:
        points_m = self._points_m.get(sighting.marker_id, ())
        return any(np.abs(sighting.point_m - point_m).max() < _SAME_POINT_M for point_m in points_m)

    def _is_certain(self, marker_id: int, evidence: _Evidence) -> bool:
        if len(evidence.heights_m) < _LEAST_SIGHTINGS:
            return False
        if evidence.path_m >= _LEAST_PATH_M or marker_id not in self._points_m:
            return True
        return marker_id not in self._at_points and len(evidence.places_m) >= _LEAST_PLACES


def _text(sighting: HeightSighting, evidence: _Evidence) -> str:
    seen_m, stated_m = median(evidence.heights_m), sighting.stated_m
    return (
        f"marker {sighting.marker_id} is at {seen_m:.3f} m, not at {stated_m:.3f} m; its position is from "
        "its full pose. Correct its height_m in lab.toml, or measure its printed side"
    )
