"""Offset between the clocks of two recorders, from markers that cameras of both saw moving.

The search correlates the pixel speeds of the same marker in both recordings. The refinement maps positions in
one image to positions in the other one: with the right offset, a smooth map fits best.
"""

from collections.abc import Collection, Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.statistics.path_pairs import PathPair, common_instants, gap_limit_s, search_speeds

Span = tuple[float, float]
Cameras = tuple[str, str]
Rows = tuple[Array, Array]

# A marker with a smaller extent of its path in px is stationary.
_LEAST_EXTENT_PX = 10.0
# Paths in more pairs of cameras cost time and add little.
_MOST_PAIRS = 24
# The degrees of the map between two images: the first one with enough instants counts.
_DEGREES = (5, 4, 3, 2)
# A map needs this many instants for each coefficient: with fewer, it follows the noise.
_INSTANTS_PER_TERM = 3
# With more instants in a path, only every n-th counts: this bounds the time of a fit.
_MOST_INSTANTS = 4000
# A marker moves if its speed is at least this share of its 90th percentile.
_MOVING_SHARE = 0.1
# The search has steps of at most 0.25 s. The refinement covers more than its error on both sides.
_REFINED_S = 0.3
# Step of the grid in which the refinement looks for low points.
_GRID_STEP_S = 0.025
# The refinement also covers clocks that differ by so many times its reach, 3 s: the usual case, also with a
# small common field of view.
_NEAR_STEPS = 10
# Low points of the grid with a misfit of at most this multiple of the lowest one are refined.
_LOW_MISFIT = 3.0
# Residuals of the maps above this share of the spread of the positions are those of unrelated paths.
_LARGEST_MISFIT = 0.02
# Another offset is a rival of the best one if the ratio of their misfits is less than this
# (test_path_that_repeats_itself_gives_no_offset).
_RIVAL_MISFIT = 2.0
# So many of the best fits are examined: each takes a jackknife.
_MOST_FITS = 12
# An offset with a large sigma is a rival, too, if its fit has at least this share of the instants of the best
# one. Paths that overlap for a short time agree at many offsets.
_RIVAL_SHARE = 0.5
# The positions between two frames are interpolated: the error of the offset is about 0.015 frame intervals at
# 10 Hz, with robots that stop and go (test_errors_of_adjacent_cameras_agree_with_their_sigmas).
_INTERVAL_SHARE = 0.02
# With a larger sigma, a robot at 0.5 m/s would be more than 1 cm off.
_LARGEST_SIGMA_S = 0.02
# The jackknife leaves out one of so many parts of the common time.
_PARTS = 10
# The refinement without a part looks for the offset this near: a larger change counts as undetermined.
_LARGEST_CHANGE_S = 0.1
# With a smaller variance, the minimum is where instants come and go, and not where the paths agree.
_LEAST_VARIANCE_S2 = 1e-14


class MarkerPath(NamedTuple):
    """The path of a marker in the images of a camera: times (n,) in s, ascending, and centres (n, 2) in px.

    All paths of a recording have one zero of time.
    """

    camera: str
    marker_id: int
    times_s: Array
    centres_px: Array


class ClockOffset(NamedTuple):
    """The offset of the second recording: the seconds to add to its times, with their standard deviation.

    ``markers`` are the ids of the markers that both recordings saw moving.
    """

    offset_s: float
    sigma_s: float
    markers: tuple[int, ...]


class _Fit(NamedTuple):
    """The maps at an offset.

    ``misfit`` is the ratio of the residuals to the spread of the positions, for the degrees of freedom.
    ``instants`` is the number of positions.
    """

    offset_s: float
    misfit: float
    instants: int


class _Pair(NamedTuple):
    """A marker in the images of two cameras: positions (n, 3) without unit, by recording."""

    cameras: Cameras
    marker_id: int
    path: PathPair


def estimate_clock_offset(first: Iterable[MarkerPath], second: Iterable[MarkerPath]) -> ClockOffset:
    """Estimate the offset of the clock of the second recording to that of the first one.

    Parameters
    ----------
    first, second : paths of markers in the images of the cameras of each recording.

    Raises
    ------
    FitError
        No marker moves in both recordings, or the paths have too few common instants, agree at no offset or
        at several offsets, or do not determine the offset well enough.

    References
    ----------
    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, sect. 11.5: jackknife.
    """
    first, first_start_s = _since_start(first)
    second, second_start_s = _since_start(second)
    pairs = _moving_pairs(first, second)
    if not pairs:
        raise FitError("no marker moves in the images of both")
    equal_s = first_start_s - second_start_s  # the offset since the starts, of clocks that are equal
    candidates_s = [equal_s + step * _REFINED_S for step in range(-_NEAR_STEPS, _NEAR_STEPS + 1)]
    # Cameras without a common field of view have no common instants at the right offset.
    for cameras in sorted({pair.cameras for pair in pairs}):
        coarse = search_speeds([pair.path for pair in pairs if pair.cameras == cameras])
        candidates_s += [offset_s for offset_s, _ in coarse]
    fits = [fit for near_s in candidates_s if (fit := _refine(pairs, near_s)) is not None]
    if not fits and not any(_degrees(_on_grid(pairs, near_s).values()) for near_s in candidates_s):
        raise FitError("their common markers have too few common instants")
    offset_s, sigma_s = _unique(pairs, sorted(fits, key=lambda fit: fit.misfit))
    markers = tuple(sorted({pair.marker_id for pair in pairs}))
    return ClockOffset(equal_s - offset_s, sigma_s, markers)


def _unique(pairs: Sequence[_Pair], fits: Sequence[_Fit]) -> tuple[float, float]:
    """Return the offset of the only fit that is sharp and good, and its standard deviation, in s.

    The fits are in the order of their misfits.
    """
    best: tuple[_Fit, float] | None = None
    blurred: list[_Fit] = []  # fits with a small misfit and a large sigma
    for fit in fits[:_MOST_FITS]:
        limit = _LARGEST_MISFIT if best is None else _RIVAL_MISFIT * best[0].misfit
        if fit.misfit > limit:
            break
        if best is not None and abs(fit.offset_s - best[0].offset_s) < _REFINED_S:
            continue
        sigma_s = _sigma_s(pairs, fit.offset_s)
        if sigma_s > _LARGEST_SIGMA_S:
            blurred.append(fit)
            continue
        if best is not None:
            raise FitError("the paths of their common markers agree at several offsets")
        best = fit, sigma_s
    if best is None and blurred:
        raise FitError(
            "the paths of their common markers agree at no offset with a standard deviation of at most "
            f"{_LARGEST_SIGMA_S:g} s"
        )
    if best is None:
        raise FitError("the paths of their common markers agree at no offset")
    rivals = [fit for fit in blurred if abs(fit.offset_s - best[0].offset_s) >= _REFINED_S]
    if any(fit.instants >= _RIVAL_SHARE * best[0].instants for fit in rivals):
        raise FitError("the paths of their common markers agree at several offsets")
    return best[0].offset_s, best[1]


def _since_start(paths: Iterable[MarkerPath]) -> tuple[list[MarkerPath], float]:
    """Return paths with times since the first one, and the time of the first one, in s."""
    paths = [path for path in paths if len(path.times_s)]
    start_s = min((float(path.times_s[0]) for path in paths), default=0.0)
    return [path._replace(times_s=path.times_s - start_s) for path in paths], start_s


def _moving_pairs(first: Iterable[MarkerPath], second: Iterable[MarkerPath]) -> list[_Pair]:
    """Return the markers that move in both recordings, for each two cameras; the longest paths first."""
    moving = [[path for path in paths if _extent_px(path) >= _LEAST_EXTENT_PX] for paths in (first, second)]
    rows = [
        (min(len(one.times_s), len(other.times_s)), one, other)
        for one in moving[0]
        for other in moving[1]
        if one.marker_id == other.marker_id
    ]
    rows.sort(key=lambda row: -row[0])
    boxes = [_boxes(paths) for paths in moving]
    return [
        _Pair(
            (one.camera, other.camera),
            one.marker_id,
            PathPair(one.times_s, _scaled(one, boxes[0]), other.times_s, _scaled(other, boxes[1])),
        )
        for _, one, other in rows[:_MOST_PAIRS]
    ]


def _extent_px(path: MarkerPath) -> float:
    """Return the larger side of the box with 90 % of the positions; single outliers have no effect."""
    if len(path.times_s) < 2:
        return 0.0
    low, high = np.quantile(path.centres_px, (0.05, 0.95), axis=0)
    return float((high - low).max())


def _boxes(paths: Sequence[MarkerPath]) -> dict[str, tuple[Array, float]]:
    """Return by camera the middle of its positions (2,) and half the larger side of their box, in px."""
    boxes = {}
    for camera in {path.camera for path in paths}:
        centres_px = np.concatenate([path.centres_px for path in paths if path.camera == camera])
        low, high = centres_px.min(axis=0), centres_px.max(axis=0)
        boxes[camera] = (low + high) / 2, float((high - low).max()) / 2
    return boxes


def _scaled(path: MarkerPath, boxes: dict[str, tuple[Array, float]]) -> Array:
    """Return the positions as points (n, 3) between -1 and 1."""
    middle_px, half_px = boxes[path.camera]
    points = (path.centres_px - middle_px) / half_px
    return np.column_stack([points, np.zeros(len(points))])


def _refine(
    pairs: Sequence[_Pair], near_s: float, reach_s: float = _REFINED_S, left_out: Span | None = None
) -> _Fit | None:
    """Return the best fit within a reach of an offset.

    Returns
    -------
    None if the instants are too few for a map, or if the fit is best at an end of the reach.
    """
    from scipy.optimize import minimize_scalar

    views = _on_grid(pairs, near_s, reach_s, left_out)
    grid_s, degrees = list(views), _degrees(views.values())
    misfits = np.array([_fit(of_offset, degrees, offset_s).misfit for offset_s, of_offset in views.items()])
    best = int(misfits.argmin())
    if not degrees or best in (0, len(grid_s) - 1):
        return None
    # The minimum may be narrower than a step of the grid, so another low point can be the best one.
    inner = misfits[1:-1]
    is_low = (inner <= misfits[:-2]) & (inner <= misfits[2:]) & (inner <= _LOW_MISFIT * misfits[best])
    fits = []
    for low in (np.flatnonzero(is_low) + 1).tolist():
        result = minimize_scalar(
            lambda offset_s: np.log(_fit(_instants(pairs, float(offset_s), left_out), degrees, 0.0).misfit),
            bounds=(grid_s[low - 1], grid_s[low + 1]),
            method="bounded",
            options={"xatol": 1e-6},
        )
        offset_s = float(result.x)
        fits.append(_fit(_instants(pairs, offset_s, left_out), degrees, offset_s))
    return min(fits, key=lambda fit: fit.misfit)


def _on_grid(
    pairs: Sequence[_Pair], near_s: float, reach_s: float = _REFINED_S, left_out: Span | None = None
) -> dict[float, dict[Cameras, list[Rows]]]:
    """Return the instants of :func:`_instants` by offset, for a grid of offsets in ascending order."""
    grid_s = near_s + np.linspace(-reach_s, reach_s, 2 * round(reach_s / _GRID_STEP_S) + 1)
    return {offset_s: _instants(pairs, offset_s, left_out) for offset_s in grid_s.tolist()}


def _instants(pairs: Sequence[_Pair], offset_s: float, left_out: Span | None) -> dict[Cameras, list[Rows]]:
    """Return for each two cameras the positions of each marker in both images, while it moves.

    Instants of the second recording between the times of ``left_out`` are left out.
    """
    views: dict[Cameras, list[Rows]] = {}
    for pair in pairs:
        views.setdefault(pair.cameras, []).append(_moving_instants(pair.path, offset_s, left_out))
    return views


def _degrees(grid: Collection[dict[Cameras, list[Rows]]]) -> dict[Cameras, int]:
    """Return the degree of the map between each two images with enough instants at all offsets of a grid.

    With fewer instants at one offset than at others, a map of the same degree fits better there.
    """
    degrees: dict[Cameras, int] = {}
    for cameras in sorted({cameras for views in grid for cameras in views}):
        degree = min(_degree([first for first, _ in views[cameras]]) for views in grid)
        if degree:
            degrees[cameras] = degree
    return degrees


def _degree(parts: Sequence[Array]) -> int:
    """Return the degree of a map of points (n, 2), by marker; 0 if the points are too few for any map."""
    count = sum(map(len, parts))
    fitting = (n for n in _DEGREES if count >= _INSTANTS_PER_TERM * _map_terms(parts, n).shape[1])
    return next(fitting, 0)


def _fit(views: dict[Cameras, list[Rows]], degrees: dict[Cameras, int], offset_s: float) -> _Fit:
    """Fit the maps of some degrees between the images at an offset, to the instants of :func:`_instants`."""
    residuals = spreads = 0.0
    total = 0
    for cameras, degree in degrees.items():
        terms = _map_terms([first for first, _ in views[cameras]], degree)
        second = np.concatenate([row for _, row in views[cameras]])
        count, coefficient_count = terms.shape
        if count <= coefficient_count:
            continue
        coefficients, *_ = np.linalg.lstsq(terms, second, rcond=1e-10)
        residual = max(float(((second - terms @ coefficients) ** 2).sum()), 1e-12)
        spread = max(float(((second - second.mean(axis=0)) ** 2).sum()), 1e-12)
        residuals += residual * count / (count - coefficient_count)
        spreads += spread
        total += count
    return _Fit(offset_s, float(np.sqrt(residuals / spreads)) if spreads else 1.0, total)


def _moving_instants(path: PathPair, offset_s: float, left_out: Span | None) -> tuple[Array, Array]:
    """Return the positions in both images, (n, 2) each, at the instants at which the marker moves.

    At other instants, the positions do not depend on the offset; and a marker that is placed by hand may have
    another height there, with another map.
    """
    times_s, points = path.track_s, path.track_m
    if left_out is not None:
        kept = (times_s < left_out[0]) | (times_s >= left_out[1])
        times_s, points = times_s[kept], points[kept]
    step = max(-(-len(times_s) // _MOST_INSTANTS), 1)
    common = common_instants([path._replace(track_s=times_s[::step], track_m=points[::step])], offset_s)
    speeds = np.linalg.norm(common.velocity_m_s, axis=1)
    moves = speeds > _MOVING_SHARE * np.quantile(speeds, 0.9) if len(speeds) else np.zeros(0, np.bool_)
    return common.true_m[moves, :2], common.track_m[moves, :2]


def _map_terms(parts: Sequence[Array], degree: int) -> Array:
    """Return the terms of the map of points (n, 2), by marker: a common polynomial, and a plane for each.

    The height of a marker shifts its image. So each marker but the first one has a plane of its own.
    """
    x, y = np.concatenate(parts).T
    columns = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    start = 0
    for number, part in enumerate(parts):
        is_own = np.zeros(len(x))
        is_own[start : start + len(part)] = 1.0
        start += len(part)
        if number and len(part):
            columns += [is_own, is_own * x, is_own * y]
    return np.column_stack(columns)


def _sigma_s(pairs: Sequence[_Pair], offset_s: float) -> float:
    """Return the standard deviation of an offset: that of a jackknife over parts of the common time.

    The interpolation between two frames is added to it. Without one of the parts, the offset may not be
    determined; then it is infinite.
    """
    times_s = np.concatenate([pair.path.track_s for pair in pairs])
    edges_s = np.quantile(times_s, np.linspace(0, 1, _PARTS + 1))
    edges_s[-1] += 1.0
    fits = [_refine(pairs, offset_s, _LARGEST_CHANGE_S, left_out) for left_out in pairwise(edges_s.tolist())]
    offsets_s = np.array([fit.offset_s for fit in fits if fit is not None])
    if len(offsets_s) < _PARTS:
        return float("inf")
    # A sharp minimum where instants come and go does not move at all without a part.
    variance_s2 = (_PARTS - 1) / _PARTS * float(((offsets_s - offsets_s.mean()) ** 2).sum())
    if variance_s2 < _LEAST_VARIANCE_S2:
        return float("inf")
    return float(np.hypot(np.sqrt(variance_s2), _INTERVAL_SHARE * _interval_s(pairs)))


def _interval_s(pairs: Sequence[_Pair]) -> float:
    """Return the mean interval between the two frames around an instant, over all instants, in s."""
    steps_s = [np.diff(pair.path.true_s) for pair in pairs]
    bridged_s = np.concatenate(
        [of_one[of_one <= gap_limit_s(pair.path.true_s)] for of_one, pair in zip(steps_s, pairs, strict=True)]
    )
    return float((bridged_s**2).sum() / bridged_s.sum())
