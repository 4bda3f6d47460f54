"""The coverage of the floor, compared with a closed form and with every marker corner."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import Camera, mount_cameras, sees
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CameraCalibration, Floor
from ipsys_log.statistics.coverage import cover_floor
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import PosedCamera, look_down, pose_facing_up, transform

Array = NDArray[np.float64]

FLOOR = Floor(2.0, 3.0)


def pinhole(camera: str, x_m: float, y_m: float, height_m: float = 2.0) -> PosedCamera:
    """Return a camera that sees 2.4 m x 1.6 m of the floor from a height of 2 m."""
    K = np.array([[1000.0, 0, 600], [0, 1000, 400], [0, 0, 1]])
    lens = CameraCalibration(0, camera, 1201, 801, "plumb_bob", np.zeros(5), K)
    return PosedCamera.at_pose(camera, lens, look_down(np.array([x_m, y_m, height_m])))


@pytest.mark.parametrize(("apart_m", "width_m"), [(1.1, 0.5), (1.4, 0.2), (1.7, -0.1)])
def test_two_cameras_that_look_straight_down(apart_m: float, width_m: float) -> None:
    cameras = [pinhole("red", 1.0, 1.5 - apart_m / 2), pinhole("white", 1.0, 1.5 + apart_m / 2)]
    found = cover_floor(FLOOR, cameras, 0.2, 0.0)
    (overlap,) = found.overlaps
    assert overlap.cameras == ("red", "white")
    assert overlap.width_m == pytest.approx(width_m, abs=0.02)
    assert overlap.at_m[1] == pytest.approx(1.5, abs=0.02)
    diagonal_m = 0.2 * np.sqrt(2)
    assert found.diagonal_m == pytest.approx(diagonal_m)
    # A strip at the centre and both ends of the floor are not visible.
    strip_m = max(0.0, diagonal_m - width_m)
    middle = [patch for patch in found.gaps if abs((patch.low_m + patch.high_m)[1] / 2 - 1.5) < 0.1]
    assert [patch.area_m2 for patch in middle] == (
        [pytest.approx(1.8 * strip_m, rel=0.12)] if strip_m else []
    )
    unseen_m = max(0.0, -width_m)
    inner = [patch for patch in found.unseen if abs((patch.low_m + patch.high_m)[1] / 2 - 1.5) < 0.1]
    assert [patch.area_m2 for patch in inner] == ([pytest.approx(2 * unseen_m, rel=0.12)] if unseen_m else [])


def test_higher_markers_are_seen_on_less_of_the_floor() -> None:
    cameras = [pinhole("red", 1.0, 0.95), pinhole("white", 1.0, 2.05)]
    widths_m = [cover_floor(FLOOR, cameras, 0.2, height_m).overlaps[0].width_m for height_m in (0.0, 0.2)]
    assert widths_m == [pytest.approx(0.5, abs=0.02), pytest.approx(0.34, abs=0.02)]


def test_only_neighbours_overlap() -> None:
    cameras = [pinhole(name, 1.0, y_m) for name, y_m in (("a", 0.5), ("b", 1.5), ("c", 2.5))]
    overlaps = cover_floor(FLOOR, cameras, 0.2, 0.0).overlaps
    assert [overlap.cameras for overlap in overlaps] == [("a", "b"), ("b", "c")]


def whole(camera: Camera, places_m: Array, length_m: float) -> NDArray[np.bool_]:
    """Return whether all corners of a marker are in the image at each of many headings."""
    found = np.ones(len(places_m), dtype=bool)
    for heading_rad in np.linspace(0, np.pi / 2, 16, endpoint=False):
        corners_m = transform(pose_facing_up(0, 0, 0, float(heading_rad)), marker_corners(length_m))
        for corner_m in corners_m:
            found &= sees(camera, places_m + corner_m)
    return found


def test_tilted_fisheye_coverage_equals_a_corner_test() -> None:
    lab = LabSettings(cameras=("red",), tilt_deg=(4.0, 6.0), mount_height_m=2.4)
    (camera,) = mount_cameras(lab)
    hung = PosedCamera.at_pose("red", camera.lens, camera.camera_from_world)
    found = cover_floor(Floor(4.88, 4.88), [hung], 0.2, 0.1)
    mask = found.whole["red"]
    step = 5
    xs_m, ys_m = np.meshgrid(found.xs_m[::step], found.ys_m[::step])
    places_m = np.column_stack([xs_m.ravel(), ys_m.ravel(), np.full(xs_m.size, 0.1)])
    sampled = mask[::step, ::step].ravel()
    # Markers that are 2 cm larger or smaller bound the result of the grid.
    surely, maybe = whole(camera, places_m, 0.22), whole(camera, places_m, 0.18)
    assert 0.1 < surely.mean() < maybe.mean() < 0.9
    assert sampled[surely].all()
    assert not sampled[~maybe].any()
    seen = sees(camera, places_m * [1, 1, 0])
    assert sum(patch.area_m2 for patch in found.unseen) == pytest.approx((~seen).mean() * 4.88**2, rel=0.02)
