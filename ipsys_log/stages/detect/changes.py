"""Where a picture has changed since it was last looked at, to know when a search is worth its while."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.images.decode import Grey

__all__ = ["Watch"]

Array = NDArray[np.float64]
Samples = NDArray[np.float32]

_EVERY_PX = 16
_HALF_PX = _EVERY_PX // 2
_CHANGED_LEVELS = 25.0
_CHANGED_SAMPLES = 3
# A marker of which only a part has changed is cut off by no less.
_AROUND_PX = 192
_ENTERED = 0.4
_MARGIN = 0.35
# A thing that stays becomes background within some ten frames.
_LEARN = np.float32(0.15)


class Watch:
    """Remembers the picture of one camera, a pixel in 16 by 16, but for where markers are known to be."""

    def __init__(self) -> None:
        self._background = np.zeros((0, 0), dtype=np.float32)

    def changed(
        self, grey: Grey, rows: Sequence[slice], markers_px: Sequence[Array], breadth_px: float
    ) -> tuple[slice, slice] | None:
        """Rows and columns around what is there and is neither background nor one of the markers.

        Parameters
        ----------
        grey : (height, width).
        rows : those that are of this frame.
        markers_px : corners (4, 2) of the markers that are known.
        breadth_px : of a marker. Less than four tenths of it at the edge of the picture is none yet.
        """
        samples = grey[_HALF_PX::_EVERY_PX, _HALF_PX::_EVERY_PX].astype(np.float32)
        if self._background.shape != samples.shape:
            # The first picture is background as a whole; rows that it lacks come with a later one.
            self._background = np.full_like(samples, np.nan)
            for part in rows:
                self._background[_samples_in(part)] = samples[_samples_in(part)]
            self.forget(markers_px)
            return None
        covered = _boxes(markers_px)
        self._forget(covered)
        new = np.zeros(samples.shape, dtype=bool)
        for part in rows:
            here = _samples_in(part)
            new[here] = self._learn(samples[here], self._background[here])
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
        """Which samples are new; they and what was not known become background."""
        off = samples - background
        background += _LEARN * off
        np.copyto(background, samples, where=np.isnan(background))
        return np.asarray(np.abs(off) > _CHANGED_LEVELS)

    def forget(self, markers_px: Sequence[Array]) -> None:
        """What lies under markers (4, 2) is not known: it is no change when it comes to light."""
        self._forget(_boxes(markers_px))

    def _forget(self, boxes: Iterable[tuple[slice, slice]]) -> None:
        for box in boxes:
            self._background[box] = np.nan


def _samples_in(rows: slice) -> slice:
    return slice(-((_HALF_PX - rows.start) // _EVERY_PX), -((_HALF_PX - rows.stop) // _EVERY_PX))


def _boxes(markers_px: Sequence[Array]) -> list[tuple[slice, slice]]:
    """Rows and columns of samples that markers (4, 2) cover, with their margin and what carries them."""
    if not markers_px:
        return []
    corners_px = np.array(markers_px)
    low, high = corners_px.min(axis=1), corners_px.max(axis=1)
    around = _MARGIN * (high - low) + _EVERY_PX
    spans = np.maximum(np.concatenate([low - around, high + around], axis=1) / _EVERY_PX, 0).astype(int)
    return [(slice(top, bottom + 2), slice(left, right + 2)) for left, top, right, bottom in spans.tolist()]


def _around(span: NDArray[np.intp]) -> slice:
    """Pixels with a marker's breadth around samples, as much of them as there is."""
    first, last = int(span[0]) * _EVERY_PX, int(span[-1] + 1) * _EVERY_PX
    return slice(max(first - _AROUND_PX, 0), last + _AROUND_PX)
