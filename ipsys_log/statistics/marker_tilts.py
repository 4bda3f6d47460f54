"""Tilts of markers in the images of a camera: do they contradict eq. (3), which knows no tilt?"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages.arrays import Array
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.square_pose import fit_squares

# Tops of robots are tilted by up to 2 degrees, and turn: two of them differ by up to 4 degrees.
_LEVEL_RAD = np.radians(6.0)
# Cameras that look down have a smaller tilt, which the models correct.
_CAMERA_RAD = np.radians(15.0)
_MOST_SIGMAS = 5.0
# The first frames are all used, then one of sixteen: a fit takes 1 ms.
_FIRST_FRAMES = 20
_EVERY_FRAME = 16
# The newest normals count.
_NORMALS = 200
# A common direction needs so many normals.
_LEAST_NORMALS = 10
# So many normals must contradict the others: a single one can be wrong.
_LEAST_TILTED = 5
# So many normals are tried as the common direction.
_CANDIDATES = 20
# A pose with a larger chi2 than the other one is not that of the marker.
_OTHER_POSE_CHI2 = 25.0
# Errors of the lens model, in px.
_LENS_PX = 0.05
# Longest usual time between the exposures of the first and the last row.
_READOUT_NS = NS_PER_S / 30


class SeenMarkers(NamedTuple):
    """The n markers in a frame whose corners go around: ``corners_px`` and ``uv`` are (n, 4, 2).

    ``whitening`` and ``lengths_m`` are as in :func:`ipsys_log.vision.square_pose.fit_squares`.
    ``sigmas_px`` (n,) are the standard deviations of the corners. ``is_sheared`` (n,) is False if the corners
    are corrected for a rolling shutter. The image has ``rows``.
    """

    time_ns: int
    ids: Sequence[int]
    corners_px: Array
    uv: Array
    whitening: Array
    lengths_m: Array
    sigmas_px: Array
    is_sheared: NDArray[np.bool_]
    rows: int


class TiltedMarker(NamedTuple):
    """A marker, and its tilt against the other markers, or against the image if all have this tilt."""

    marker_id: int
    tilt_rad: float


class _Normal(NamedTuple):
    """The normals (2, 3) of a marker by its two poses, equal if only one is possible, and their sigma."""

    marker_id: int
    normals: Array
    sigma_rad: float


class MarkerTilts:
    """The memory of the normals of the markers that a camera sees; it reports a tilted marker once."""

    def __init__(self) -> None:
        self._frames = 0
        self._normals: deque[_Normal] = deque(maxlen=_NORMALS)
        self._centres_px: dict[int, tuple[int, Array]] = {}
        self._has_reported = False

    def is_next(self) -> bool:
        """Count a frame; return whether its normals are used."""
        self._frames += 1
        is_used = self._frames <= _FIRST_FRAMES or self._frames % _EVERY_FRAME == 0
        return is_used and not self._has_reported

    def add(self, seen: SeenMarkers) -> TiltedMarker | None:
        """Use the markers of a frame; return a marker whose tilt has become certain."""
        more_px = np.hypot(_LENS_PX, self._shears_px(seen))
        shares = seen.sigmas_px / np.hypot(seen.sigmas_px, more_px)
        poses = fit_squares(seen.uv, seen.whitening * shares[:, None, None], seen.lengths_m)
        for n, marker_id in enumerate(seen.ids):
            normals = poses.rotations[n, :, :, 2].copy()
            if np.ptp(poses.chi2[n]) > _OTHER_POSE_CHI2:
                normals[:] = normals[poses.chi2[n].argmin()]
            self._normals.append(_Normal(marker_id, normals, float(poses.tilt_sigmas_rad[n])))
        tilted = self._tilted() if len(self._normals) >= _LEAST_NORMALS else None
        self._has_reported = tilted is not None
        return tilted

    def _shears_px(self, seen: SeenMarkers) -> Array:
        """Return the greatest errors (n,) of corners by a rolling shutter, from the motion since a frame."""
        centres_px = seen.corners_px.mean(axis=1)
        sides_px = np.ptp(seen.corners_px[:, :, 1], axis=1)
        shears_px = np.zeros(len(seen.ids))
        for n, marker_id in enumerate(seen.ids):
            before_ns, before_px = self._centres_px.get(marker_id, (seen.time_ns, centres_px[n]))
            self._centres_px[marker_id] = seen.time_ns, centres_px[n]
            share = min(1.0, _READOUT_NS / max(seen.time_ns - before_ns, 1)) * sides_px[n] / seen.rows / 2
            shears_px[n] = seen.is_sheared[n] * share * np.linalg.norm(centres_px[n] - before_px)
        return shears_px

    def _tilted(self) -> TiltedMarker | None:
        """Return the marker that most often contradicts the direction that most markers face."""
        normals = np.array([one.normals for one in self._normals])
        slack_rad = _MOST_SIGMAS * np.array([one.sigma_rad for one in self._normals])
        down = np.array([[0.0, 0.0, -1.0]])
        few = normals[:: max(1, len(normals) // _CANDIDATES)]
        candidates = np.concatenate([down, few.reshape(-1, 3)])
        angles = np.arccos(np.clip(np.einsum("nkd,cd->cnk", normals, candidates), -1, 1)).min(axis=2)
        best = int((angles - slack_rad <= _LEVEL_RAD).sum(axis=1).argmax())
        for own_rad, most_rad in ((angles[best], _LEVEL_RAD), (angles[0], _CAMERA_RAD)):
            tilted = np.flatnonzero(own_rad - slack_rad > most_rad)
            if len(tilted) >= _LEAST_TILTED:
                ((marker_id, _),) = Counter(self._normals[n].marker_id for n in tilted).most_common(1)
                own = [own_rad[n] for n in tilted if self._normals[n].marker_id == marker_id]
                return TiltedMarker(marker_id, float(np.median(own)))
        return None
