"""Motion in the images of one camera: changed areas, and tracks of markers with their predictions."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Grey
from ipsys_log.stages.detect.adjustment import Guess, MarkerFit
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotation, rotation_vector

Samples = NDArray[np.float32]

_EVERY_PX = 16
_HALF_PX = _EVERY_PX // 2
_CHANGED_LEVELS = 25.0
_CHANGED_SAMPLES = 3
# Margin around changed samples. It also contains the rest of a marker of which only a part has changed.
_AROUND_PX = 192
_ENTERED = 0.4
_MARGIN = 0.35
# Share of a change that each frame adds to the background. A stationary object becomes background within
# about ten frames.
_LEARN = np.float32(0.15)


class ChangeDetector:
    """The background image of one camera: one pixel of each 16 by 16 block, without the known markers."""

    def __init__(self) -> None:
        self._background = np.zeros((0, 0), dtype=np.float32)

    def find_change(
        self, grey: Grey, rows: Sequence[slice], markers_px: Sequence[Array], breadth_px: float
    ) -> tuple[slice, slice] | None:
        """Return rows and columns around an area that is neither background nor a known marker, or None.

        Parameters
        ----------
        grey : (height, width).
        rows : the rows of ``grey`` that belong to this frame.
        markers_px : corners (4, 2) of the known markers.
        breadth_px : width of a marker. An area at the border of the image that is narrower than 0.4 times
            this width does not count as a change yet.
        """
        samples = grey[_HALF_PX::_EVERY_PX, _HALF_PX::_EVERY_PX].astype(np.float32)
        if self._background.shape != samples.shape:
            # The whole first image is background. A later image provides its missing rows.
            self._background = np.full_like(samples, np.nan)
            for part in rows:
                self._background[_samples_in(part)] = samples[_samples_in(part)]
            self.forget(markers_px)
            return None
        covered = _boxes(markers_px)
        self._forget(covered)
        new = np.zeros(samples.shape, dtype=bool)
        for part in rows:
            block = _samples_in(part)
            new[block] = self._learn(samples[block], self._background[block])
        self._forget(covered)
        if np.count_nonzero(new) < _CHANGED_SAMPLES:
            return None
        spans = [np.flatnonzero(new.any(axis=1)), np.flatnonzero(new.any(axis=0))]
        for span, last in zip(spans, np.array(new.shape) - 1, strict=True):
            at_edge = span[0] == 0 or span[-1] == last
            if at_edge and (span[-1] - span[0] + 1) * _EVERY_PX < _ENTERED * breadth_px:
                return None
        return _around(spans[0]), _around(spans[1])

    def _learn(self, samples: Samples, background: Samples) -> NDArray[np.bool_]:
        """Return a mask of the new samples; add them and the unknown samples to the background."""
        differences = samples - background
        background += _LEARN * differences
        np.copyto(background, samples, where=np.isnan(background))
        return np.asarray(np.abs(differences) > _CHANGED_LEVELS)

    def forget(self, markers_px: Sequence[Array]) -> None:
        """Mark the background under markers (4, 2) as unknown: it is no change when it becomes visible."""
        self._forget(_boxes(markers_px))

    def _forget(self, boxes: Iterable[tuple[slice, slice]]) -> None:
        for box in boxes:
            self._background[box] = np.nan


def _samples_in(rows: slice) -> slice:
    return slice(-((_HALF_PX - rows.start) // _EVERY_PX), -((_HALF_PX - rows.stop) // _EVERY_PX))


def _boxes(markers_px: Sequence[Array]) -> list[tuple[slice, slice]]:
    """Return rows and columns of samples that markers (4, 2), their margins and their carriers cover."""
    if not markers_px:
        return []
    corners_px = np.array(markers_px)
    low, high = corners_px.min(axis=1), corners_px.max(axis=1)
    around = _MARGIN * (high - low) + _EVERY_PX
    spans = np.maximum(np.concatenate([low - around, high + around], axis=1) / _EVERY_PX, 0).astype(int)
    return [(slice(top, bottom + 2), slice(left, right + 2)) for left, top, right, bottom in spans.tolist()]


def _around(span: NDArray[np.intp]) -> slice:
    """Return the pixels of samples and up to a marker's width around them, from pixel 0 on."""
    first, last = int(span[0]) * _EVERY_PX, int(span[-1] + 1) * _EVERY_PX
    return slice(max(first - _AROUND_PX, 0), last + _AROUND_PX)


# After this time, an earlier motion predicts nothing.
LONG_S = 0.5
# Largest speed of a robot, in sides of the marker per s.
_FASTEST = 100.0
_REMEMBERED = 3
# In sides per s and rad per s: a smaller difference is not visible in the shear of a marker.
_SAME_SPEED = 0.1


class MarkerSighting(NamedTuple):
    """A marker pose at the exposure of its row, ``late_ns`` after the first row of its frame."""

    time_ns: int
    late_ns: int
    pose: Guess


# The newest sighting first.
Track = tuple[MarkerSighting, ...]


def extend(track: Track, fit: MarkerFit, frame_ns: int, row_time_s: float) -> Track:
    """Return a track, possibly empty, with the new fit of its marker in front.

    Parameters
    ----------
    frame_ns : exposure time of the first row of the frame.
    row_time_s : time between the exposures of two rows.
    """
    late_ns = round(float(fit.corners_px[:, 1].mean()) * row_time_s * NS_PER_S)
    now = MarkerSighting(frame_ns + late_ns, late_ns, fit.pose)
    # Without an increase of time there is no speed.
    ordered = not track or track[0].time_ns < now.time_ns
    return (now, *track[: _REMEMBERED - 1]) if ordered else (now,)


def predict(track: Track, frame_ns: int) -> Guess:
    """Return the predicted pose of a marker in a frame, if the marker is in about the same row as before.

    The prediction is on a parabola through three sightings, or on a line through two. If the last sighting is
    old, or if the speed would be too high for a robot, the prediction is the last pose.
    """
    now = track[0]
    ahead_s = (frame_ns + now.late_ns - now.time_ns) / NS_PER_S
    if len(track) == 1 or not 0 <= ahead_s < LONG_S:
        return now.pose
    steps_s = [(newer.time_ns - older.time_ns) / NS_PER_S for newer, older in pairwise(track)]
    moved = [newer.pose.centre - older.pose.centre for newer, older in pairwise(track)]
    means = [step / step_s for step, step_s in zip(moved, steps_s, strict=True)]
    if np.abs(means).max() > _FASTEST:
        return now.pose
    # A mean velocity is valid for the middle of its interval.
    gain = (means[0] - means[1]) / (sum(steps_s) / 2) if len(means) > 1 else np.zeros(3)
    velocity = means[0] + gain * steps_s[0] / 2
    turn_rad_s = rotation_vector(now.pose.rotation @ track[1].pose.rotation.T) / steps_s[0]
    turned = rotation(turn_rad_s * ahead_s) @ now.pose.rotation
    speed, turn = (velocity + gain * ahead_s) @ turned, turn_rad_s @ turned
    centre = now.pose.centre + (velocity + gain * ahead_s / 2) * ahead_s
    return Guess(now.pose.id, turned, centre, np.array([speed[0], speed[1], turn[2]]), now.pose.blurred)


def same_speed(one: Array | None, other: Array | None) -> bool:
    """Return whether two motions, as in :class:`Guess`, are equal within the visible difference."""
    if one is None or other is None:
        return one is other
    return bool(np.abs(one - other).max() < _SAME_SPEED)
