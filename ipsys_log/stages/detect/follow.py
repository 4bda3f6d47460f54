"""Markers of one camera from frame to frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
_SEARCH_EVERY = 10
_THOROUGH_EVERY = 60
# And decoded as a whole every so many; the others only as far as markers are expected.
_WHOLE_EVERY = 5
_MARGIN_PX = 48
# Of two fits of one id, nearer together than this, one is enough.
_SAME_PX = 8.0


class _Track(NamedTuple):
    """A marker at a time, and how it moved before: in its sides per s, and as a vector in rad per s."""

    time_ns: int
    pose: Guess
    velocity: Array
    turn_rad_s: Array

    def predict(self, time_ns: int) -> Guess:
        dt_s = (time_ns - self.time_ns) / NS_PER_S
        turn = rotation(self.turn_rad_s * dt_s)
        return Guess(self.pose.id, turn @ self.pose.rotation, self.pose.centre + self.velocity * dt_s)


class Follow:
    """Finds the markers of one camera in frame after frame, starting from where it found them before.

    Parameters
    ----------
    dictionary : OpenCV's name, such as DICT_4X4_100.
    lens : of the camera.
    edge_offset_px : as for :func:`fit_edges`.
    """

    def __init__(
        self,
        dictionary: str,
        lens: CameraCalibration,
        edge_offset_px: float | None,
    ) -> None:
        self._dictionary = dictionary
        self._lens = lens
        self._edge_offset_px = edge_offset_px
        self._canvas = Canvas()
        self._watch = Watch()
        self._changed: tuple[slice, slice] | None = None
        self._breadth_px = 0.0
        self._frames = 0
        self._tracks: list[_Track] = []

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
        guesses = [track.predict(time_ns) for track in self._tracks]
        outlines_px = [self._outline(guess) for guess in guesses]
        grey, rows = self._canvas.show(frame, None if whole else _rows(outlines_px, self._changed))
        tried = self._fit(grey, guesses)
        fits = [fit for fit in tried if fit is not None]
        lost = {
            guess.id
            for guess, fit, outline_px in zip(guesses, tried, outlines_px, strict=True)
            if fit is None and _inside(outline_px, grey)
        }
        if lost and rows != slice(0, len(grey)):
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
        return fit_edges(grey, guesses, self._dictionary, self._lens, self._edge_offset_px)

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

    def _remember(self, fits: Sequence[Fit], time_ns: int) -> None:
        before = {track.pose.id: track for track in self._tracks}
        self._tracks = [_track(before.get(fit.pose.id), fit.pose, time_ns) for fit in fits]
        if fits:
            self._breadth_px = max(float(np.ptp(fit.corners_px, axis=0).min()) for fit in fits)


def _track(before: _Track | None, pose: Guess, time_ns: int) -> _Track:
    if before is None or time_ns <= before.time_ns:
        return _Track(time_ns, pose, np.zeros(3), np.zeros(3))
    dt_s = (time_ns - before.time_ns) / NS_PER_S
    turn_rad = rotation_vector(pose.rotation @ before.pose.rotation.T)
    return _Track(time_ns, pose, (pose.centre - before.pose.centre) / dt_s, turn_rad / dt_s)


def _among(marker_id: int, corners_px: Array, fits: Iterable[Fit]) -> bool:
    return any(
        fit.pose.id == marker_id and np.abs(fit.corners_px - corners_px).max() < _SAME_PX for fit in fits
    )


def _rows(outlines_px: Sequence[Array], changed: tuple[slice, slice] | None) -> slice:
    """The rows that markers are expected in, with what is needed around them, and those that have changed."""
    spans = [(int(px[:, 1].min()) - _MARGIN_PX, int(px[:, 1].max()) + _MARGIN_PX) for px in outlines_px]
    if changed is not None:
        spans.append((changed[0].start, changed[0].stop))
    if not spans:
        return slice(0, 0)
    return slice(max(min(low for low, _ in spans), 0), max(0, *(high for _, high in spans)))


def _inside(outline_px: Array, grey: Grey) -> bool:
    height, width = grey.shape
    return bool(((outline_px > 0) & (outline_px < [width - 1, height - 1])).all())
