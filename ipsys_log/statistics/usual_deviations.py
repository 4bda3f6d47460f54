"""The usual deviations of the cameras at each place, the heights of the markers, and slow motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ipsys_log.messages import Array
from ipsys_log.statistics.deviations import PAIR, REFERENCE, RISE, Deviation, DeviationKind, PlaceKey
from ipsys_log.units import NS_PER_S

# Slow changes of a place by temperature, as a share of the standard deviation of its passes, per root of s;
# and their bound.
_DRIFT, _MOST_DRIFT = 0.04, 2.5
# A place forgets passes before its last ones.
_MOST_PASSES = 20
# The heights are estimated once in so many steps.
_SOLVED_EVERY = 6
# Standard deviation of a robot's height in the rig, with the error of its print; of a reference marker: none.
_HEIGHT_SIGMA_M = 2e-3
# A robot is known below this standard deviation.
_KNOWN_M = 5e-4
# Share of a new square in the mean that scales the variances, and bounds of this scale.
_SHARE, _SCALES = 0.005, (0.25, 25.0)

# Passes over a place whose mean is its first deviation, for slow changes; and passes since then.
_FIRST_PASSES = 5
# Standard deviations of a slow motion of a camera where no deviation shows it: turn about each axis in rad,
# and shift along each in m.
_SLOW = np.repeat([3e-4, 3e-4], 3)
_MOTION = 6
_KINDS = {kind.name: kind for kind in (PAIR, RISE, REFERENCE)}


@dataclass(slots=True, eq=False)
class _Pass:
    """The mean of the passes of a marker over a place: value, slope by its height, and weight, (k,)."""

    value: Array
    by_height: Array
    weight: Array
    count: int = 1


class _Mean(NamedTuple):
    """The mean (k,) of a place, its variance (k,), and the part of this by the heights of the markers."""

    value: Array
    variance: Array
    by_heights: Array


@dataclass(slots=True, eq=False)
class _Place:
    """The passes over a place by marker, the time of the last one, and their slopes by motions of cameras.

    ``first`` is the mean of the first passes, ``later`` the number of passes since.
    """

    passes: dict[int, _Pass] = field(default_factory=dict)
    time_ns: int = 0
    slopes: dict[str, Array] = field(default_factory=dict)
    first: _Mean | None = None
    later: int = 0


class UsualDeviations:
    """The usual deviations of each place, and the heights of the markers on robots, by least squares.

    A deviation is that of its place, plus that of its marker times the slope. The places are eliminated, so
    that the heights follow from one small system; they are exact also before the places are known well.
    """

    def __init__(self) -> None:
        self._places: dict[PlaceKey, _Place] = {}
        self._scales: dict[str, Array] = {}
        self._learned = 0
        self._heights: dict[str, tuple[dict[int, int], Array, Array]] = {}

    def forget(self, marker_id: int) -> None:
        """Forget the passes of a marker, which has another height now."""
        for place in self._places.values():
            place.passes.pop(marker_id, None)
        for kind in [*self._heights]:
            self._solve(kind)

    def forget_camera(self, camera: str) -> None:
        """Forget all deviations of a camera, which has another pose now."""
        self._places = {key: place for key, place in self._places.items() if camera not in key[1]}

    def compare(self, one: Deviation, time_ns: int) -> tuple[Array, Array] | None:
        """Return the difference (k,) to the usual deviation, and its variances; None at unknown places."""
        place = self._places.get(one.key)
        mean = None if place is None else self._mean(one.kind, place, one)
        if place is None or mean is None or mean.by_heights.max(initial=0.0) > _KNOWN_M**2:
            return None
        age_s = max(time_ns - place.time_ns, 0) / NS_PER_S
        aged = min(_DRIFT**2 * age_s, _MOST_DRIFT**2) * one.kind.passes**2
        return one.value - mean.value, self._variance(one) + mean.variance + aged

    def _mean(self, kind: DeviationKind, place: _Place, one: Deviation | None) -> _Mean | None:
        """Return the mean of a place, with the height of the marker of a deviation there; None if unknown."""
        none = dict[int, int](), np.zeros(0), np.zeros((0, 0))
        numbers, heights_m, covariance = self._heights.get(kind.name, none)
        weight, total = 1 / kind.places**2, np.zeros(len(kind.places))
        slopes = np.zeros((len(kind.places), len(heights_m)))
        known = {
            marker_id: own
            for marker_id, own in place.passes.items()
            if kind is REFERENCE or marker_id in numbers
        }
        for marker_id, own in known.items():
            weight, total = weight + own.weight, total + own.weight * own.value
            if kind is not REFERENCE:
                slopes[:, numbers[marker_id]] -= own.weight * own.by_height
        total, slopes = total / weight, slopes / weight[:, None]
        if one is not None and kind is not REFERENCE:
            if one.marker_id not in numbers:
                return None
            slopes[:, numbers[one.marker_id]] += one.by_marker[:, 0]
        by_heights = ((slopes @ covariance) * slopes).sum(axis=1)
        return _Mean(total + slopes @ heights_m, 1 / weight + by_heights, by_heights) if known else None

    def slow_motions(self, cameras: Sequence[str]) -> dict[str, tuple[Array, Array]]:
        """Return the motion (6,) of each camera since its first deviations, and its covariance (6, 6).

        All cameras are estimated together: they share the deviations of pairs.
        """
        columns = {camera: slice(_MOTION * n, _MOTION * (n + 1)) for n, camera in enumerate(cameras)}
        information = np.diag(np.tile(1 / _SLOW**2, len(cameras)))
        gradient = np.zeros(len(information))
        for key, place in self._places.items():
            mean = None if place.first is None else self._mean(_KINDS[key[0]], place, None)
            if place.first is None or mean is None or place.later < _FIRST_PASSES:
                continue
            slopes = np.zeros((len(mean.value), len(information)))
            for camera, own in place.slopes.items():
                slopes[:, columns[camera]] = own
            weighted = slopes / (mean.variance + place.first.variance)[:, None]
            information += slopes.T @ weighted
            gradient += weighted.T @ (mean.value - place.first.value)
        covariance: Array = np.asarray(np.linalg.inv(information))
        motion: Array = covariance @ gradient
        return {camera: (motion[own], covariance[own, own]) for camera, own in columns.items()}

    def _variance(self, one: Deviation) -> Array:
        """Return the variance (k,) of one pass."""
        scale = self._scales.get(one.kind.name, np.ones(len(one.value)))
        return np.asarray(one.kind.passes**2 * scale + one.noise)

    def learn(self, deviations: list[Deviation], time_ns: int) -> None:
        """Average deviations into those of their places."""
        for one in deviations:
            compared = self.compare(one, time_ns)
            if compared is not None:
                change = np.clip(compared[0] ** 2 / compared[1], 0, 9) - 1
                scale = self._scales.get(one.kind.name, np.ones(len(one.value)))
                self._scales[one.kind.name] = np.clip(scale * np.exp(_SHARE * change), *_SCALES)
            place = self._places.setdefault(one.key, _Place())
            place.time_ns, weight, place.slopes = time_ns, 1 / self._variance(one), one.slopes
            place.later += 1
            if place.first is None and place.later > _FIRST_PASSES:
                place.first, place.later = self._mean(one.kind, place, None), 0
            slope = np.zeros(len(one.value)) if one.kind is REFERENCE else one.by_marker[:, 0]
            known = place.passes.get(one.marker_id)
            if known is None:
                place.passes[one.marker_id] = _Pass(one.value, slope, weight)
                continue
            known.count = min(known.count + 1, _MOST_PASSES)
            known.value = known.value + (one.value - known.value) / known.count
            known.by_height = known.by_height + (slope - known.by_height) / known.count
            known.weight = weight * known.count
        self._learned += 1
        fresh = {one.kind.name for one in deviations if one.kind is not REFERENCE}
        for kind in fresh if self._learned % _SOLVED_EVERY == 0 or not self._heights else ():
            self._solve(kind)

    def _solve(self, kind: str) -> None:
        """Estimate the heights of all markers from their passes."""
        own = [(key, place) for key, place in self._places.items() if key[0] == kind and place.passes]
        ids = sorted({marker_id for _, place in own for marker_id in place.passes})
        numbers = {marker_id: number for number, marker_id in enumerate(ids)}
        rows = [
            (index, numbers[marker_id], known)
            for index, (_, place) in enumerate(own)
            for marker_id, known in place.passes.items()
        ]
        if not rows:
            del self._heights[kind]
            return
        places, markers = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
        values, slopes, weights = (
            np.array([getattr(row[2], name) for row in rows]) for name in ("value", "by_height", "weight")
        )
        prior = _KINDS[kind].places
        total, mean = np.tile(1 / prior**2, (len(own), 1)), np.zeros((len(own), len(prior)))
        np.add.at(total, places, weights)
        np.add.at(mean, places, weights * values)
        coupling = np.zeros((len(own), len(prior), len(ids)))
        coupling[places, :, markers] = weights * slopes
        information = np.diag(np.full(len(ids), 1 / _HEIGHT_SIGMA_M**2))
        np.add.at(information, (markers, markers), (weights * slopes**2).sum(axis=1))
        gradient = np.zeros(len(ids))
        np.add.at(gradient, markers, (weights * slopes * values).sum(axis=1))
        flat = (coupling / np.sqrt(total)[..., None]).reshape(-1, len(ids))
        information -= flat.T @ flat
        gradient -= flat.T @ (mean / np.sqrt(total)).reshape(-1)
        covariance = np.linalg.inv(information)
        self._heights[kind] = numbers, covariance @ gradient, covariance
