"""Tests of intrinsics, and of the lengths, heights and tilts of markers, by the images of markers.

The intrinsics are contradicted if the correction that explains the shapes of level markers is much larger
than the errors of a calibration, beside its own uncertainty; or if the corners of markers are not those of
squares. Markers in a hand explain nothing: their scatter makes the correction uncertain.
"""

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraCalibration, Marker, Markers, Rig
from ipsys_log.statistics.marker_shapes import (
    LEVEL_SCATTER,
    SHAPE_SIGMA,
    MarkerPlaces,
    MarkerSightings,
    SeenShapes,
    ShapeFit,
    fit_shapes,
)
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.square_pose import fit_squares, is_convex, reprojection_px, solve_squares

# Least contradiction, as a share of the distance.
_SIZE_SHARE = 0.03
# Least contradiction in units of the scatter of distances.
_SIZE_SCATTER = 4.0
# A median of fewer sightings of a marker is not reliable.
_LEAST_OF_MARKER = 5


class Contradiction(NamedTuple):
    """A sentence about a marker, or about two of which one is wrong."""

    text: str
    marker_id: int | None = None


class SizeTest:
    """The test of one camera, as markers arrive; each contradiction is returned once."""

    def __init__(self, camera: str, lens: CameraCalibration, rig: Rig) -> None:
        self.camera, self.lens, self.rig = camera, lens, rig
        self._sightings = MarkerSightings()
        self._wrong_markers: set[int] = set()

    def add(self, time_ns: int, markers: Sequence[Marker]) -> Iterator[Contradiction]:
        """Add the markers of a frame."""
        for _, is_due in self._sightings.add(time_ns, markers):
            seen = self._sightings.shapes(self.lens) if is_due else None
            if seen is None or sum(self.rig.height_of(n) is not None for n in seen.known_ids) < 2:
                continue
            fit = fit_shapes(seen, False)
            if fit is not None and fit.rms < LEVEL_SCATTER:
                yield from self._test_sizes(seen, fit)
        self._sightings.renew()

    def _floor_distances(self, seen: SeenShapes, fit: ShapeFit) -> dict[int, Array]:
        """Return distances of the floor from the camera in m, by the marker of known height."""
        floors_m: dict[int, Array] = {}
        for marker_id in seen.known_ids:
            height_m = self.rig.height_of(marker_id)
            distances_m = fit.distances[seen.ids == marker_id] * self.rig.length_of(marker_id)
            if height_m is not None and len(distances_m) >= _LEAST_OF_MARKER:
                floors_m[marker_id] = distances_m + height_m
        return floors_m

    def _test_sizes(self, seen: SeenShapes, fit: ShapeFit) -> Iterator[Contradiction]:
        """Find markers that are at another height than the rig says, as those of a wrong length are."""
        floors_m = self._floor_distances(seen, fit)
        if len(floors_m) < 2:
            return
        centres_m = {marker_id: float(np.median(values_m)) for marker_id, values_m in floors_m.items()}
        middle_m = float(np.median(list(centres_m.values())))
        scatter_m = 1.48 * float(np.median([np.median(abs(v - np.median(v))) for v in floors_m.values()]))
        bound_m = max(_SIZE_SHARE * middle_m, _SIZE_SCATTER * scatter_m)
        # The middle of two markers has half of their contradiction on each side.
        bound = bound_m / 2 if len(floors_m) == 2 else bound_m
        wrong = [n for n, centre_m in centres_m.items() if abs(centre_m - middle_m) > bound]
        if set(wrong) <= self._wrong_markers or len(wrong) > (2 if len(floors_m) == 2 else 1):
            return
        self._wrong_markers.update(wrong)
        if len(floors_m) == 2:
            share = max(centres_m.values()) / min(centres_m.values()) - 1
            yield Contradiction(
                f"camera {self.camera}: the sizes of markers {wrong[0]} and {wrong[1]} contradict each other "
                f"by {100 * share:.0f} %; measure their sides, and correct length_m or the height in the rig"
            )
            return
        for marker_id in wrong:
            share = centres_m[marker_id] / middle_m - 1
            yield Contradiction(
                f"camera {self.camera}: marker {marker_id} looks {100 * abs(share):.0f} % too "
                f"{'small' if share > 0 else 'large'} beside the others; measure its side, and correct its "
                "length_m or its height in the rig",
                marker_id,
            )


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


# Chi-square of seven parameters: chance exceeds it once in 10,000 tests.
_CHI2 = 30.0
# Least deviation of shapes that the correction explains: a good calibration has 0.4 % at the border.
_LEAST_EFFECT = 0.005
# Least ratio of the deviations before and after the correction: other causes leave their deviations.
_LEAST_RATIO = 1.5
# Error of the square fit of raw corners in a blurred photograph, and by a bent print in shares of the side.
_FIT_PX = 0.7
_FIT_SHARE = 0.01
# Least ratio of the median to this error. In real videos of a moving board, the median is up to 1.4 px.
_FIT_FACTOR = 3.0
# A median of fewer fits is not reliable.
_LEAST_FITS = 8
# Corners with a smaller residual are those of a fitted square: they say nothing about their shape.
_FITTED_PX = 1e-4


class IntrinsicsTest:
    """The test of the intrinsics of one camera, as markers arrive; a contradiction is returned once."""

    def __init__(self, camera: str, lens: CameraCalibration) -> None:
        self.camera, self.lens = camera, lens
        self.is_contradicted = False
        self._sightings = MarkerSightings()
        self._fitted_places = MarkerPlaces()
        self._fits_px: list[tuple[float, float]] = []

    def add(self, time_ns: int, markers: Sequence[Marker]) -> Iterator[str]:
        """Add the markers of a frame; yield a sentence if the intrinsics are contradicted now."""
        if self.is_contradicted:
            return
        for marker, is_due in self._sightings.add(time_ns, markers):
            self._fit(marker)
            if is_due:
                yield from self.finish()
        if self._sightings.renew():
            self._fits_px.clear()
            self._fitted_places = MarkerPlaces()

    def finish(self) -> Iterator[str]:
        """Test the markers so far."""
        if self.is_contradicted:
            return
        yield from self._test_squares()
        seen = None if self.is_contradicted else self._sightings.shapes(self.lens)
        if seen is None:
            return
        with np.errstate(invalid="ignore", divide="ignore"):  # a correction can move corners out of the lens
            given, corrected = fit_shapes(seen, False), fit_shapes(seen, True)
        if given is not None and corrected is not None and _contradicts(given, corrected):
            sides_px = np.linalg.norm(seen.corners_px - np.roll(seen.corners_px, 1, axis=1), axis=2)
            px = float(np.median(sides_px)) / np.sqrt(2)
            yield self._contradict(
                f"shapes of level markers {given.rms * px:.1f} px wrong, "
                f"{max(corrected.rms, SHAPE_SIGMA) * px:.1f} px expected"
            )

    def add_squares(self, markers: Sequence[Marker]) -> Iterator[str]:
        """Add raw corners of markers whose edges are fitted, or cannot be fitted: fitted ones are square."""
        if self.is_contradicted:
            return
        for marker in markers:
            if self._fitted_places.add(marker):
                self._fit(marker)
                yield from self._test_squares()

    def _fit(self, marker: Marker) -> None:
        """Note the residual (RMS) of the square fit and the usual one, in px."""
        uv = undistort(marker.corners_px, self.lens)
        side_px = float(
            np.linalg.norm(marker.corners_px - np.roll(marker.corners_px, 1, axis=0), axis=1).mean()
        )
        expected_px = float(np.hypot(_FIT_PX, _FIT_SHARE * side_px))
        if not np.isfinite(uv).all() or not is_convex(uv):
            self._fits_px.append((side_px / 2, expected_px))
            return
        length = np.ones(1)
        poses = solve_squares(uv[None], length)
        misses_px = reprojection_px(*poses, length, marker.corners_px[None], self.lens)
        fit_px = float(np.nanmin(misses_px))
        if fit_px > _FITTED_PX:
            self._fits_px.append((fit_px, expected_px))

    def _test_squares(self) -> Iterator[str]:
        if self.is_contradicted or len(self._fits_px) < _LEAST_FITS:
            return
        fit_px, expected_px = np.median(np.array(self._fits_px), axis=0).tolist()
        if fit_px > _FIT_FACTOR * expected_px:
            yield self._contradict(f"square fit {fit_px:.1f} px, {expected_px:.1f} px expected")

    def _contradict(self, figures: str) -> str:
        self.is_contradicted = True
        return (
            f"camera {self.camera}: markers do not fit its calibration ({figures}); is it the file of this "
            "camera, size and lens model?"
        )


def _contradicts(given: ShapeFit, corrected: ShapeFit) -> bool:
    return (
        corrected.chi2 > _CHI2
        and corrected.rms < LEVEL_SCATTER
        and given.rms**2 - corrected.rms**2 > _LEAST_EFFECT**2
        and given.rms > _LEAST_RATIO * corrected.rms
    )


def find_contradicted_inputs(
    frames: Iterable[tuple[str, Markers]], lenses: Mapping[str, CameraCalibration], rig: Rig
) -> Iterator[str]:
    """Yield what the frames of cameras contradict: intrinsics that are not nominal, and sizes of the rig."""
    tests = {
        camera: (IntrinsicsTest(camera, lens), SizeTest(camera, lens, rig))
        for camera, lens in lenses.items()
        if lens.D.any()
    }
    for camera, frame in frames:
        if camera in tests:
            intrinsics, sizes = tests[camera]
            yield from intrinsics.add(frame.timestamp, frame.markers)
            yield from (text for text, _ in sizes.add(frame.timestamp, frame.markers))
    for intrinsics, _ in tests.values():
        yield from intrinsics.finish()
