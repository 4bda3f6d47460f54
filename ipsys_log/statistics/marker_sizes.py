"""Test of the lengths and heights of markers in the rig, by the sizes of their images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ipsys_log.messages import CameraCalibration, Marker, Rig
from ipsys_log.messages.arrays import Array
from ipsys_log.statistics.marker_shapes import (
    LEVEL_SCATTER,
    MarkerSightings,
    SeenShapes,
    ShapeFit,
    fit_shapes,
)

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
    """The test of one camera, as markers arrive; each contradiction is returned once.

    Parameters
    ----------
    camera : name of the camera, for texts.
    lens : intrinsics of the camera.
    rig : lengths and heights of the markers.
    """

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
