"""Test of camera intrinsics by the images of markers: squares that lie level.

The intrinsics are contradicted if the correction that explains the shapes of level markers is much larger
than the errors of a calibration, beside its own uncertainty; or if the corners of markers are not those of
squares. Markers in a hand explain nothing: their scatter makes the correction uncertain.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from ipsys_log.messages import CameraCalibration, Marker, Markers, Rig
from ipsys_log.statistics.marker_shapes import (
    LEVEL_SCATTER,
    SHAPE_SIGMA,
    MarkerPlaces,
    MarkerSightings,
    ShapeFit,
    fit_shapes,
)
from ipsys_log.statistics.marker_sizes import SizeTest
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.square_pose import is_convex, reprojection_px, solve_squares

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
    """The test of the intrinsics of one camera, as markers arrive; a contradiction is returned once.

    Parameters
    ----------
    camera : name of the camera, for texts.
    lens : intrinsics of the camera.
    """

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
