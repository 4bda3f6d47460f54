"""Markers of one camera from frame to frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.ippe import solve_squares
from ipsys_log.geometry.lenses import project, undistort
from ipsys_log.geometry.markers import marker_corners
from ipsys_log.geometry.poses import rotation, rotation_vector
from ipsys_log.geometry.square_pose import goes_around
from ipsys_log.messages import CameraCalibration, CompressedImage, RawImage
from ipsys_log.stages.detect.decode import Canvas, Grey
from ipsys_log.stages.detect.edges import Fit, Guess, fit_edges
from ipsys_log.stages.detect.search import WHOLE, Candidate, search, search_thoroughly
from ipsys_log.stages.detect.watch import Watch
from ipsys_log.units import NS_PER_S

__all__ = ["Follow"]

Array = NDArray[np.float64]

# The whole picture is searched every so many frames, whatever happens, and more thoroughly, at full size,
# every so many.
_SEARCH_EVERY = 20
_THOROUGH_EVERY = 120
# And decoded as a whole every so many; the others only as far as markers are expected.
_WHOLE_EVERY = 5
_MARGIN_PX = 32
_REMEMBERED = 3
# In sides per s and rad per s: less is not seen in the shear of a marker.
_SAME_SPEED = 0.1
# Of two fits of one id, nearer together than this, one is enough.
_SAME_PX = 8.0


class _Sighting(NamedTuple):
    """A marker when its row was exposed, ``late_ns`` after the first row of its frame."""

    time_ns: int
    late_ns: int
    pose: Guess


class Follow:
    """Finds the markers of one camera in frame after frame, starting from where it found them before.

    Parameters
    ----------
    dictionary : OpenCV's name, such as DICT_4X4_100.
    lens : of the camera.
    edge_offset_px, row_time_s : as for :func:`fit_edges`.
    """

    def __init__(
        self,
        dictionary: str,
        lens: CameraCalibration,
        edge_offset_px: float | None,
        row_time_s: float,
    ) -> None:
        self._dictionary = dictionary
        self._lens = lens
        self._edge_offset_px = edge_offset_px
        self._row_time_s = row_time_s
        self._canvas = Canvas()
        self._watch = Watch()
        self._changed: tuple[slice, slice] | None = None
        self._breadth_px = 0.0
        self._frames = 0
        # Of each marker the last sightings, the newest first.
        self._tracks: dict[int, tuple[_Sighting, ...]] = {}

    def __call__(self, frame: CompressedImage | RawImage, time_ns: int) -> tuple[list[Fit], int, int]:
        """The markers in a frame, sorted by id, and the width and height of it; an id can occur twice.

        Parameters
        ----------
        frame : as recorded.
        time_ns : when it was taken.

        Raises
        ------
        ValueError
            Where it cannot be decoded.
        """
        due = self._frames % _SEARCH_EVERY == 0
        thorough = self._frames % _THOROUGH_EVERY == _SEARCH_EVERY
        whole = due or self._frames % _WHOLE_EVERY == 0
        self._frames += 1
        guesses = [_predict(track, time_ns) for track in self._tracks.values()]
        outlines_px = [self._outline(guess) for guess in guesses]
        grey, rows = self._canvas.show(frame, None if whole else _rows(outlines_px, self._changed))
        tried = self._with_speed(grey, time_ns, guesses, self._fit(grey, guesses))
        fits = [fit for fit in tried if fit is not None]
        lost = {
            guess.id
            for guess, fit, outline_px in zip(guesses, tried, outlines_px, strict=True)
            if fit is None and _inside(outline_px, grey)
        }
        if lost and rows != [slice(0, len(grey))]:
            grey, rows = self._canvas.show(frame)
        self._changed = self._watch.changed(grey, rows, [fit.corners_px for fit in fits], self._breadth_px)
        region = WHOLE if lost or due else self._changed
        if region is not None:
            fits = self._add(grey, fits, search(grey, self._dictionary, region))
        if thorough or lost - {fit.pose.id for fit in fits}:
            fits = self._add(grey, fits, search_thoroughly(grey, self._dictionary))
        self._watch.forget([fit.corners_px for fit in fits])
        self._remember(fits, time_ns)
        return sorted(fits, key=lambda fit: fit.pose.id), grey.shape[1], grey.shape[0]

    def _fit(self, grey: Grey, guesses: Sequence[Guess]) -> list[Fit | None]:
        return fit_edges(grey, guesses, self._dictionary, self._lens, self._edge_offset_px, self._row_time_s)

    def _with_speed(
        self, grey: Grey, frame_ns: int, guesses: Sequence[Guess], fits: list[Fit | None]
    ) -> list[Fit | None]:
        """Where rows take time, the same fits with the speeds that follow from them."""
        if not self._row_time_s:
            return fits
        again = {}
        for n, (guess, fit) in enumerate(zip(guesses, fits, strict=True)):
            if fit is not None:
                known = _predict(self._extended(fit, frame_ns), frame_ns)
                if not _same_speed(known.motion, guess.motion):
                    again[n] = known
        better = dict(zip(again, self._fit(grey, list(again.values())), strict=True))
        return [better.get(n) or fit for n, fit in enumerate(fits)]

    def _extended(self, fit: Fit, frame_ns: int) -> tuple[_Sighting, ...]:
        """The track of a marker with what was just seen of it."""
        late_ns = round(float(fit.corners_px[:, 1].mean()) * self._row_time_s * NS_PER_S)
        now = _Sighting(frame_ns + late_ns, late_ns, fit.pose)
        before = self._tracks.get(fit.pose.id, ())
        # Time that does not go on leaves nothing to learn a speed from.
        ordered = not before or before[0].time_ns < now.time_ns
        return (now, *before[: _REMEMBERED - 1]) if ordered else (now,)

    def _add(self, grey: Grey, fits: list[Fit], candidates: Iterable[Candidate]) -> list[Fit]:
        """Fits, and those of candidates that are none of them."""
        new = [one for one in candidates if not _among(one.id, one.corners_px, fits)]
        fits = list(fits)
        for fit in self._fit(grey, self._guess(new)):
            if fit is not None and not _among(fit.pose.id, fit.corners_px, fits):
                fits.append(fit)
        return fits

    def _guess(self, candidates: Sequence[Candidate]) -> list[Guess]:
        """Poses of squares: of the two that look alike, the one that faces the camera's plane."""
        if not candidates:
            return []
        corners_px = np.array([one.corners_px for one in candidates])
        uv = undistort(corners_px.reshape(-1, 2), self._lens).reshape(-1, 4, 2)
        usable = [n for n, corners in enumerate(uv) if np.isfinite(corners).all() and goes_around(corners)]
        if not usable:
            return []
        rotations, centres = solve_squares(uv[usable], np.ones(len(usable)))
        upright = rotations[:, :, 2, 2].argmin(axis=1)
        return [
            Guess(candidates[n].id, rotations[k, upright[k]], centres[k, upright[k]])
            for k, n in enumerate(usable)
        ]

    def _outline(self, guess: Guess) -> Array:
        """Corners in px, (4, 2)."""
        return project(marker_corners(1.0) @ guess.rotation.T + guess.centre, self._lens)

    def _remember(self, fits: Sequence[Fit], frame_ns: int) -> None:
        self._tracks = {fit.pose.id: self._extended(fit, frame_ns) for fit in fits}
        if fits:
            self._breadth_px = max(float(np.ptp(fit.corners_px, axis=0).min()) for fit in fits)


def _predict(track: Sequence[_Sighting], frame_ns: int) -> Guess:
    """Where a marker is in a frame, if it lies in about the same row: on a parabola through three sightings,
    on a line through two."""
    now = track[0]
    if len(track) == 1:
        return now.pose
    ahead_s = (frame_ns + now.late_ns - now.time_ns) / NS_PER_S
    steps_s = [(one.time_ns - other.time_ns) / NS_PER_S for one, other in pairwise(track)]
    moved = [one.pose.centre - other.pose.centre for one, other in pairwise(track)]
    means = [step / step_s for step, step_s in zip(moved, steps_s, strict=True)]
    # A mean velocity is that of the middle of its interval.
    gain = (means[0] - means[1]) / (sum(steps_s) / 2) if len(means) > 1 else np.zeros(3)
    velocity = means[0] + gain * steps_s[0] / 2
    turn_rad_s = rotation_vector(now.pose.rotation @ track[1].pose.rotation.T) / steps_s[0]
    turned = rotation(turn_rad_s * ahead_s) @ now.pose.rotation
    speed, turn = (velocity + gain * ahead_s) @ turned, turn_rad_s @ turned
    centre = now.pose.centre + (velocity + gain * ahead_s / 2) * ahead_s
    return Guess(now.pose.id, turned, centre, np.array([speed[0], speed[1], turn[2]]), now.pose.blurred)


def _same_speed(one: Array | None, other: Array | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.abs(one - other).max() < _SAME_SPEED)


def _among(marker_id: int, corners_px: Array, fits: Iterable[Fit]) -> bool:
    return any(
        fit.pose.id == marker_id and np.abs(fit.corners_px - corners_px).max() < _SAME_PX for fit in fits
    )


def _rows(outlines_px: Sequence[Array], changed: tuple[slice, slice] | None) -> list[slice]:
    """The rows that markers are expected in, with what is needed around them, and those that have changed."""
    rows = [
        slice(max(int(px[:, 1].min()) - _MARGIN_PX, 0), max(int(px[:, 1].max()) + _MARGIN_PX, 0))
        for px in outlines_px
    ]
    return rows if changed is None else [*rows, changed[0]]


def _inside(outline_px: Array, grey: Grey) -> bool:
    height, width = grey.shape
    return bool(((outline_px > 0) & (outline_px < [width - 1, height - 1])).all())
