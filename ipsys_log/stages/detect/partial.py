"""Fit of a marker that glare, a shadow or a cover hides in part, from three good sides and the cells.

Edges that contradict the others, or do not have the shape of an edge, get no weight. A side that is hidden
along its whole length looks like a good side at another position. The fit is therefore tried without each of
the four sides, and the fit with the least residuals is selected. The intrinsics are known, so a pose has six
degrees of freedom. The other sides and the edges between cells determine them. The corners beside a hidden
side follow from the pose, and their covariance from that of the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraCalibration, Grey, Mask
from ipsys_log.stages.detect.adjustment import (
    Guess,
    MarkerFit,
    edge_derivatives,
    inside_image,
    outline,
    poses_of,
    prior,
    sample_cells,
    solve,
)
from ipsys_log.stages.detect.cells import count_wrong_cells
from ipsys_log.stages.detect.prints import (
    EdgePositions,
    MarkerView,
    Poses,
    Prints,
    build_prints,
    locate,
    read_profiles,
)
from ipsys_log.stages.detect.uneven_light import (
    TAPS,
    Steps,
    compare_pattern,
    count_contradictions,
    exact_steps,
    has_clear_cells,
    masked_median,
    rough_steps,
    usual_blur,
)

# The omitted side of each hypothesis: none, or one of the four sides.
_WITHOUT = (None, 0, 1, 2, 3)
_FAR_PX, _NEAR_PX, _OF_CELL = 12.0, 3.0, 0.45
# Passes with far profiles and with near ones, before and after the selection of the better of two poses.
_ROUGH, _EXACT, _FINAL = 3, 2, 2
_REWEIGHTED = 3
_SHORT_PX = 8.0
# Tukey's biweight: the residual from which weights are 0, in standard deviations, and its minimum.
_CUT, _CUT_PX, _CUT_ROUGH, _CUT_ROUGH_OF_REACH = 4.0, 0.08, 3.0, (0.36, 0.24, 0.15)
# Edges with larger residuals, in px, cost as much as missing ones.
_COSTLY_PX = 0.4
# A whole side is disturbed if its displacement exceeds this number of standard deviations and of px.
_DISTURBED, _DISTURBED_PX = 6.0, 0.06
_CHEAPER, _ALIKE_POSES = 0.03, 0.06
# Least share of visible edges of a side, and of all edges together; and their largest cost.
_SEEN, _SEEN_OF_ALL, _COST = 0.3, 0.4, 0.7
_MOST_UNCERTAIN_PX = 1.0
# Least share of clear edges between cells: other prints show a third at most, markers in glare four fifths.
_CLEAR_INSIDE = 0.5
# Prints that are no flat squares: least share of clear edges at the sides, which a wider border lacks; and
# largest distance of corners from the square, and least sigma, in px
# (test_edges_find_as_many_photographs_as_stock).
_CLEAR_SIDES = 0.3
_FARTHEST_CORNER_PX, _CORNER_SIGMA_PX = 8, 0.3
_REFINE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.001)
# In cells narrower than this, edges disturb one another.
_LEAST_CELL_PX = 2.2
# Factor for covariances: errors of neighbouring edges are correlated, but least squares assumes that they
# are not.
_ALIKE = 1.7


class Rejection(NamedTuple):
    """A visible marker that cannot be measured, and the reason, in a text without changing numbers."""

    id: int
    reason: str


def resembles(grey: Grey, lens: CameraCalibration, dictionary: str, guesses: Sequence[Guess]) -> bool:
    """Return whether cells look like those of a marker, for any of its possible poses.

    If they do not, and the ordinary fit has failed, the marker is absent. The partial fit takes as long as
    ten ordinary fits. For such markers it succeeds in none of 315 rendered frames.
    """
    guesses = [guess for guess in guesses if poses_of([guess]).is_visible()[0]]
    if not guesses:
        return False
    marker_id = guesses[0].id
    view = MarkerView(grey, lens, build_prints(dictionary, (marker_id,) * len(guesses)), 0.0, None)
    *_, levels = outline(view, poses_of(guesses))
    return any(compare_pattern(row, dictionary, marker_id).possible for row in levels)


def fit_visible_edges(
    grey: Grey,
    guesses: Sequence[Guess],
    dictionary: str,
    lens: CameraCalibration,
    edge_offset_px: float | None = None,
    row_time_s: float = 0.0,
    blur_px: float | None = None,
    near: bool = False,
) -> MarkerFit | Rejection | None:
    """Fit one marker to its visible edges.

    Parameters
    ----------
    guesses : possible poses, the likelier pose first.
    grey, dictionary, lens, edge_offset_px, row_time_s, blur_px : as for
        :func:`ipsys_log.stages.detect.edges.fit_edges`.
    near : True if the guesses have errors of at most one or two pixels.

    Returns
    -------
    The fit; a rejection if cells show this id but the pose cannot be determined; or None if the image does
    not show the marker.
    """
    guesses = [guess for guess in guesses if poses_of([guess]).is_visible()[0]]
    if not guesses:
        return None
    trial = _PartialFit(grey, lens, dictionary, guesses, edge_offset_px, row_time_s, blur_px, near)
    return trial.judge(trial.settle())


class _State(NamedTuple):
    """Hypotheses: poses, motions (m, 3), and the omitted side of each, (m,), -1 for none."""

    poses: Poses
    motions: Array
    without: NDArray[np.int_]

    def only(self, chosen: NDArray[np.intp]) -> _State:
        poses = Poses(self.poses.rotations[chosen], self.poses.centres[chosen])
        return _State(poses, self.motions[chosen], self.without[chosen])


class _Solved(NamedTuple):
    """Least squares of hypotheses: as for :func:`~ipsys_log.stages.detect.adjustment.solve`.

    ``left_px`` (m, s) are the residuals of the edges. ``costs`` (m,) are their mean costs, without the edges
    of the omitted side.
    """

    rows: Array
    normal: Array
    unknowns: Array
    weights: Array
    left_px: Array
    clear: Mask
    costs: Array
    blur_px: float

    def variance_px2(self, n: int) -> float:
        """Return the variance of the positions of edges about a fit, in px^2."""
        weights = self.weights[n]
        freedoms = max(float(weights.sum()) - self.rows.shape[1], 1.0)
        return float((weights * self.left_px[n] ** 2).sum() / freedoms)


class _PartialFit:
    """Fits of one marker with several poses, and with and without each of its sides."""

    def __init__(
        self,
        grey: Grey,
        lens: CameraCalibration,
        dictionary: str,
        guesses: Sequence[Guess],
        edge_offset_px: float | None,
        row_time_s: float,
        blur_px: float | None,
        near: bool,
    ) -> None:
        self._grey, self._lens, self._dictionary = grey, lens, dictionary
        self._row_time_s, self._blur_px = row_time_s, blur_px
        self._guesses, self._id = guesses, guesses[0].id
        self._unknowns = 9 if row_time_s else 7
        self._edge_offset_px = edge_offset_px
        self._near, self._first = near, _ROUGH - 1 if near else 0
        prints = build_prints(dictionary, (self._id,))
        self._sides = (prints.by_side[0] > 0).T
        self._real, self._cells = prints.polarity[0] != 0, prints.cells

    def settle(self) -> tuple[_State, _Solved]:
        """Return the five hypotheses of the better pose, and the residuals of each."""
        guesses = [guess for guess in self._guesses for _ in _WITHOUT]
        self._known, self._hold = prior(guesses, self._edge_offset_px)
        without = np.array([-1 if side is None else side for _ in self._guesses for side in _WITHOUT])
        state = _State(poses_of(guesses), self._known[:, 7:], without)
        for number in range(self._first, _ROUGH + _EXACT):
            state, solved = self._move(state, number)
        # If poses look alike, the first pose is the likelier one.
        costs = solved.costs.reshape(-1, len(_WITHOUT)).min(axis=1)
        best = int(costs.argmin()) if costs.min() < costs[0] - _ALIKE_POSES else 0
        chosen = np.arange(len(_WITHOUT)) + best * len(_WITHOUT)
        self._known, self._hold = self._known[chosen], self._hold[chosen]
        state = state.only(chosen)
        for _ in range(_FINAL):
            state, solved = self._move(state, _ROUGH + _EXACT)
        return state, solved

    def _move(self, state: _State, number: int) -> tuple[_State, _Solved]:
        """Return hypotheses after one pass of least squares, and the residuals before it."""
        count = len(state.without)
        view = MarkerView(
            self._grey,
            self._lens,
            build_prints(self._dictionary, (self._id,) * count),
            self._row_time_s,
            None,
        )
        sites = locate(view, state.poses, state.motions)
        steps, blur_px, least_px = self._steps(view, sites, number)
        used = np.where(state.without[:, None] >= 0, ~self._sides[state.without], True)
        rows = edge_derivatives(
            view.prints, state.poses.camera_positions(), sites.slopes, sites.late, self._unknowns
        )
        off_px = steps.off_px
        if self._row_time_s:
            off_px = off_px + (state.motions[:, None, :2] @ rows[:, 7:])[:, 0]
        known, hold = self._known[:, : self._unknowns], self._hold[:, : self._unknowns]
        clear = steps.clear & used
        weights = clear.astype(np.float64)
        for _ in range(_REWEIGHTED):
            normal, unknowns = solve(rows, weights, off_px, known, hold)
            left_px = off_px - (unknowns[:, None] @ rows)[:, 0]
            spread_px = 1.4826 * masked_median(np.abs(left_px), clear)
            cut_px = np.maximum((_CUT if number >= _ROUGH else _CUT_ROUGH) * spread_px, least_px)
            weights = clear * _biweight(left_px / cut_px)
        cost = np.where(clear, 1.0 - _biweight(left_px / _COSTLY_PX), 1.0)
        counted = used & self._real
        costs = (cost * counted).sum(axis=1) / counted.sum(axis=1)
        shift_px = np.abs((unknowns[:, None, :6] @ rows[:, :6])[:, 0]).max(axis=1)
        short = np.minimum(1.0, _SHORT_PX / np.maximum(shift_px, _SHORT_PX))
        moved = state.poses.move(unknowns[:, :6] * short[:, None])
        poses = moved.select(moved.is_visible(), state.poses)
        motions = state.motions
        if self._row_time_s:
            motions = np.concatenate([unknowns[:, 7:], motions[:, 2:]], axis=1)
        solved = _Solved(rows, normal, unknowns, weights, left_px, steps.clear, costs, blur_px)
        return _State(poses, motions, state.without), solved

    def _steps(self, view: MarkerView, sites: EdgePositions, number: int) -> tuple[Steps, float, float]:
        """Return the steps at edges, their blur, and the least residual from which weights may be 0."""
        farthest_px = _FAR_PX if number < _ROUGH else _NEAR_PX
        cell_px = float(np.quantile(sites.slopes[0], 0.2)) / view.prints.cells
        reach_px = round(min(max(_OF_CELL * cell_px, 0.8), farthest_px), 1)
        profiles = read_profiles(view.grey, sites, np.full((len(sites.slopes), 1), reach_px), TAPS)
        if number < _ROUGH:
            return rough_steps(view.prints, profiles, reach_px), 0.0, _CUT_ROUGH_OF_REACH[number] * reach_px
        blur_px = self._blur_px
        if blur_px is None:
            blur_px = usual_blur(view.prints, profiles[0], reach_px)
            if number > _ROUGH:
                self._blur_px = blur_px
        return exact_steps(view.prints, profiles, reach_px, blur_px), blur_px, _CUT_PX

    def judge(self, settled: tuple[_State, _Solved]) -> MarkerFit | Rejection | None:
        """Return the fit of the best hypothesis, a rejection, or None if the marker is absent."""
        state, solved = settled
        n = self._choose(state, solved)
        view = MarkerView(
            self._grey, self._lens, build_prints(self._dictionary, (self._id,)), self._row_time_s, None
        )
        corners_px, slopes, levels = outline(view, state.only(np.array([n])).poses)
        agreement = compare_pattern(levels[0], self._dictionary, self._id)
        if not inside_image(corners_px, self._grey)[0] or not agreement.likely:
            return None
        pose = Guess(self._id, state.poses.rotations[n], state.poses.centres[n])
        samples = sample_cells(view, pose)
        is_other_print = count_contradictions(samples, self._dictionary, self._id) > 0
        if agreement.clear and solved.clear[n] @ view.prints.inner[0, :, 0] < _CLEAR_INSIDE:
            is_other_print = True
        if is_other_print and not self._near:
            return None  # only a marker that was here can be covered by black or white
        covariance_px2 = self._covariance(solved, n, slopes[0])
        hider = _hider(levels[0], view.prints)
        if is_other_print:
            reason = f"{hider} hides some of its cells"
        elif not agreement.clear:
            reason = f"{hider} hides too many of its cells"
        elif _width_px(corners_px[0]) / view.prints.cells < _LEAST_CELL_PX:
            reason = f"its cells are under {_LEAST_CELL_PX} px wide, and some of its edges are disturbed"
        elif hidden_part := self._hidden_part(solved.weights[n]):
            reason = f"{hider} hides {hidden_part}"
        elif solved.costs[n] > _COST or np.diag(covariance_px2).max() > _MOST_UNCERTAIN_PX**2:
            reason = "its edges are too disturbed to fit a flat square"
        else:
            spread_px = float(np.sqrt(solved.variance_px2(n)))
            offset_px = float(solved.unknowns[n, 6])
            return MarkerFit(pose, corners_px[0], covariance_px2, offset_px, spread_px, solved.blur_px, True)
        if self._near:
            return Rejection(self._id, reason)  # the search gives a better start
        has_sides = (solved.clear[n] @ view.prints.by_side[0]).mean() > _CLEAR_SIDES
        if agreement.clear and has_sides and has_clear_cells(samples, self._dictionary, self._id):
            return self._fit_corners(pose, corners_px[0], solved, n) or Rejection(self._id, reason)
        return Rejection(self._id, reason)

    def _fit_corners(self, pose: Guess, outline_px: Array, solved: _Solved, n: int) -> MarkerFit | None:
        """Return a marker with the corners in the image, if nothing hides the print but it is no flat square.

        Bent paper and wrong intrinsics have this effect. The covariance contains the distance from a square.
        """
        window_px = max(3, min(round(_width_px(outline_px) / (3 * self._cells)), _FARTHEST_CORNER_PX))
        corners_px = outline_px
        for reach_px in (window_px, 3):
            start = corners_px.astype(np.float32).reshape(-1, 1, 2)
            refined = cv2.cornerSubPix(self._grey, start, (reach_px, reach_px), (-1, -1), _REFINE)
            corners_px = refined.reshape(4, 2).astype(np.float64)
        off_px = float(np.sqrt(np.square(corners_px - outline_px).sum(axis=1).mean()))
        if off_px > window_px or count_wrong_cells(self._grey, self._id, corners_px, self._dictionary):
            return None
        covariance_px2 = np.eye(8) * max(off_px, _CORNER_SIGMA_PX) ** 2
        offset_px = float(solved.unknowns[n, 6])
        return MarkerFit(pose, corners_px, covariance_px2, offset_px, off_px, solved.blur_px, True)

    def _hidden_part(self, weights: Array) -> str:
        """Return the part of the edges that is hidden, if it is too large to fit the marker; else ""."""
        seen = [float(weights[side].sum() / side.sum()) for side in self._sides]
        lost = sum(share < _SEEN for share in seen)
        if lost > 1:
            return f"{lost} of its 4 sides"
        return "most of its edges" if weights.sum() < _SEEN_OF_ALL * self._real.sum() else ""

    def _choose(self, state: _State, solved: _Solved) -> int:
        """Return the hypothesis with all sides, or the hypothesis without a completely disturbed side."""
        n = 1 + int(solved.costs[1:].argmin())
        if solved.costs[0] > solved.costs[n] + _CHEAPER:
            return n
        side = self._sides[state.without[n]] & solved.clear[n]
        if np.count_nonzero(side) < 2:
            return 0
        off_px = solved.left_px[n][side]
        polarity = build_prints(self._dictionary, (self._id,)).polarity[0][side]
        row = (solved.rows[n][:, side] * polarity).mean(axis=1)
        mean_px = float((off_px * polarity).mean())
        variance = 1 / len(off_px) + float(row @ np.linalg.solve(solved.normal[n], row))
        sigma_px = float(np.sqrt(solved.variance_px2(n) * variance))
        return n if abs(mean_px) > max(_DISTURBED * sigma_px, _DISTURBED_PX) else 0

    def _covariance(self, solved: _Solved, n: int, slopes: Array) -> Array:
        """Return the covariance (8, 8) of the corners, in px^2."""
        inverse = np.linalg.inv(solved.normal[n])
        rows, weights = solved.rows[n], solved.weights[n]
        unknowns_covariance = inverse @ ((rows * weights**2) @ rows.T) @ inverse * solved.variance_px2(n)
        return np.asarray(_ALIKE * slopes @ unknowns_covariance[:6, :6] @ slopes.T, dtype=np.float64)


def _biweight(shares: Array) -> Array:
    """Return Tukey's weights of residuals in units of the residual with weight 0."""
    return np.asarray((1.0 - np.minimum(shares * shares, 1.0)) ** 2)


def _width_px(corners_px: Array) -> float:
    """Return the width of a foreshortened square, corners (4, 2): its area over its longest side."""
    (x, y), (next_x, next_y) = corners_px.T, np.roll(corners_px, -1, axis=0).T
    longest = np.hypot(next_x - x, next_y - y).max()
    return float(abs((x * next_y - next_x * y).sum()) / 2 / max(longest, 1e-9))


def _hider(levels: Array, prints: Prints) -> str:
    """Return the name of the cause that hides a part of a marker, by the levels of its cells."""
    white = prints.white[0]
    middle = (np.median(levels[white]) + np.median(levels[~white])) / 2
    bright, dark = np.count_nonzero(levels[~white] > middle), np.count_nonzero(levels[white] < middle)
    return "glare" if bright > dark else "a shadow or an object"
