"""Paths of robots from sightings of their markers: their parts, their knots, and a first fit."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from ipsys_log.calibration.joint.normal import NormalEquations
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.calibration.joint.parameters import State
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.start import PlacedCamera
from ipsys_log.calibration.joint.trajectories import Paths, Trajectories
from ipsys_log.messages import Array, Indices

# A longer time without sightings divides a path.
_GAP_S = 1.0
# A part of a path with fewer sightings, or shorter, is left out.
_LEAST_SIGHTINGS = 8
_LEAST_S = 0.5
# Time between knots, in intervals between the frames of a camera,
_FRAMES_PER_KNOT = 1.0
# and its limits.
_SHORTEST_STEP_S = 0.09
_LONGEST_STEP_S = 0.25
# The path continues this long before and after its sightings, because clocks have offsets.
PAD_S = 0.25
# Errors of a place and of a heading from one marker and rough camera poses.
_PLACE_M = 0.01
_HEADING_RAD = 0.02
_ROUNDS = 4
# In a hall, a longer part of a path is divided. A robot passes only a few cameras in this time, and its place
# at a cut is known from their sightings alone.
_LONGEST_PART_S = 10.0
# A marker this far from its height is in the hand of a person, and not on a robot.
_FAR_M = 0.25


class StartedPaths(NamedTuple):
    """Paths, their knots (k, 3), and the path of each sighting of each camera; -1 without a path."""

    paths: Paths
    knots: Array
    numbers: list[Indices]


class _Places(NamedTuple):
    """Places of one body (n, 3: x, y, heading) at times (n,), by camera and row, ordered by time."""

    times_s: Array
    places: Array
    cameras: Indices
    rows: Indices


def start_paths(
    observations: Observations, placed: list[PlacedCamera], settings: JointSettings
) -> StartedPaths:
    """Return paths through all sightings of moving bodies, from rough poses of the cameras."""
    numbers = [np.full(len(sightings), -1, dtype=np.intp) for sightings in observations.sightings]
    columns: list[tuple[float, float, int, int, int]] = []
    parts: list[_Places] = []
    first = 0
    for body in range(len(observations.bodies)):
        longest_s = _LONGEST_PART_S if observations.in_hall else np.inf
        for part in _parts(_places(observations, placed, body), longest_s):
            step_s = _step(part)
            start_s = float(part.times_s[0]) - PAD_S
            count = int(np.ceil((part.times_s[-1] + PAD_S - start_s) / step_s)) + 3
            for camera, rows in enumerate(numbers):
                rows[part.rows[part.cameras == camera]] = len(columns)
            columns.append((start_s, step_s, first, count, body))
            parts.append(part)
            first += count
    starts_s, steps_s, firsts, counts, bodies = (
        np.array([column[k] for column in columns], dtype=np.float64) for k in range(5)
    )
    paths = Paths(starts_s, steps_s, *(one.astype(np.intp) for one in (firsts, counts, bodies)))
    return StartedPaths(paths, _fit_knots(paths, parts, settings), numbers)


def _places(observations: Observations, placed: list[PlacedCamera], body: int) -> _Places:
    """Return where the rays of the cameras meet the height of a moving body."""
    height_m = observations.bodies[body].height_m
    rows: list[tuple[Array, ...]] = []
    for camera, (view, sightings) in enumerate(zip(placed, observations.sightings, strict=True)):
        own = np.flatnonzero((sightings.body == body) & (sightings.point < 0))
        if height_m is None or not len(own):
            continue
        with np.errstate(all="ignore"):
            along = (height_m - view.origin_m[2]) / view.rays[own, 2]
        places_m = view.origin_m + along[:, None] * view.rays[own]
        good = np.isfinite(places_m).all(axis=1) & (along > 0)
        good &= np.abs(view.points_m[own, 2] - height_m) < _FAR_M
        rows.append(
            (
                sightings.times_s[own][good],
                places_m[good, 0],
                places_m[good, 1],
                view.headings_rad[own][good],
                np.full(int(good.sum()), camera, dtype=np.float64),
                own[good].astype(np.float64),
            )
        )
    if not rows:
        return _Places(np.zeros(0), np.zeros((0, 3)), *(np.zeros(0, dtype=np.intp),) * 2)
    times_s, x, y, heading, cameras, indices = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(times_s, kind="stable")
    places = np.stack([x, y, heading], axis=1)[order]
    return _Places(times_s[order], places, cameras[order].astype(np.intp), indices[order].astype(np.intp))


def _parts(places: _Places, longest_s: float) -> list[_Places]:
    """Divide the places of a body at gaps and into parts of equal duration, and leave out short parts."""
    cuts = np.flatnonzero(np.diff(places.times_s) > _GAP_S) + 1
    parts = []
    whole = np.split(np.arange(len(places.times_s)), cuts)
    for rows in (part for own in whole for part in _divide(places.times_s, own, longest_s)):
        if len(rows) < _LEAST_SIGHTINGS or np.ptp(places.times_s[rows]) < _LEAST_S:
            continue
        times_s, own, cameras, indices = places
        part = _Places(times_s[rows], own[rows], cameras[rows], indices[rows])
        headings = np.unwrap(part.places[:, 2])
        parts.append(part._replace(places=np.column_stack([part.places[:, :2], headings])))
    return parts


def _divide(times_s: Array, rows: Indices, longest_s: float) -> list[Indices]:
    if not len(rows) or not np.isfinite(longest_s):
        return [rows]
    first_s, last_s = times_s[rows[0]], times_s[rows[-1]]
    count = max(int(np.ceil((last_s - first_s) / longest_s)), 1)
    limits_s = np.linspace(first_s, last_s, count + 1)[1:-1]
    return np.split(rows, np.searchsorted(times_s[rows], limits_s))


def _step(part: _Places) -> float:
    intervals_s = [
        np.median(np.diff(part.times_s[part.cameras == camera]))
        for camera in np.unique(part.cameras)
        if (part.cameras == camera).sum() > 2
    ]
    usual_s = float(min(intervals_s, default=_LONGEST_STEP_S))
    return float(np.clip(_FRAMES_PER_KNOT * usual_s, _SHORTEST_STEP_S, _LONGEST_STEP_S))


def _fit_knots(paths: Paths, parts: list[_Places], settings: JointSettings) -> Array:
    """Return the knots (k, 3) of the paths through all places."""
    if not parts:
        return np.zeros((0, 3))
    trajectories = Trajectories(0, paths, settings.acceleration_sigma, settings.turn_sigma)
    numbers = np.repeat(np.arange(len(parts)), [len(part.times_s) for part in parts])
    times_s = np.concatenate([part.times_s for part in parts])
    places = np.concatenate([part.places for part in parts])
    sigmas = np.array([_PLACE_M, _PLACE_M, _HEADING_RAD])
    return smooth_knots(paths, numbers, times_s, places, sigmas, trajectories)


def cover_times(times_s: Array, step_s: float) -> Paths:
    """Return one path that covers times (n,), with knots ``step_s`` apart."""
    start_s = float(times_s.min()) - PAD_S
    count = int(np.ceil((float(times_s.max()) + PAD_S - start_s) / step_s)) + 3
    first = np.zeros(1, dtype=np.intp)
    return Paths(np.array([start_s]), np.array([step_s]), first, np.array([count]), first)


def smooth_knots(
    paths: Paths, numbers: Indices, times_s: Array, places: Array, sigmas: Array, trajectories: Trajectories
) -> Array:
    """Return knots (k, d) of paths through places, robust against wrong ones.

    Parameters
    ----------
    paths : the paths of ``trajectories``, over the floor (d = 3) or free (d = 6).
    numbers, times_s, places : (n,), (n,) and (n, d), path, time and place of each sighting.
    sigmas : (d,), usual errors of a place.
    trajectories : the paths with their accelerations, and no stationary pose.
    """
    size = places.shape[1]
    empty = State(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    knots = np.zeros((paths.knot_count, size))
    near, weights, _ = paths.weights(numbers, times_s)
    slopes = weights[:, None, :, None] * (np.eye(size) / sigmas)[None, :, None, :]
    slopes = slopes.reshape(len(places), size, 4 * size)
    roots = np.ones(len(places))
    for _ in range(_ROUNDS):
        normal = NormalEquations(size * paths.knot_count, 0, trajectories.bandwidth)
        values = (weights[:, :, None] * knots[near[:, None] + np.arange(4)]).sum(axis=1)
        residuals = (values - places) / sigmas
        normal.add_local(size * near, slopes * roots[:, None, None], residuals * roots[:, None])
        moved = replace(empty, knots=knots) if size == 3 else replace(empty, free_knots=knots)
        trajectories.add_smoothness(normal, moved)
        step = solveh_banded(normal.band, -normal.local_gradient, lower=True, check_finite=False)
        knots = knots + step.reshape(-1, size)
        values = (weights[:, :, None] * knots[near[:, None] + np.arange(4)]).sum(axis=1)
        chi2 = (((values - places) / sigmas) ** 2).sum(axis=1)
        roots = 1 / np.sqrt(1 + chi2 / max(9.0, 4 * float(np.median(chi2))))
    return knots
