"""Intervals of a stationary marker and of a slowly moving marker."""

import numpy as np
import pytest

from ipsys_log.live_runs.survey.scene import CameraView, observe_marker
from ipsys_log.messages import CameraPoint, CameraPoints
from ipsys_log.statistics.calibration_points import TimedPoints
from ipsys_log.statistics.stationary import is_stationary, stationary_intervals
from ipsys_log.units import NS_PER_S
from tests import labs

Array = labs.Array

RATE_HZ = 30


def seen(path_m: Array, start_s: float = 0.0, across_m: float = 0.0008, along: float = 0.002) -> TimedPoints:
    """Return a path (n, 3) of camera points at 30 Hz, with the noise of plain corners."""
    rng = np.random.default_rng(4)
    noisy = path_m * (1 + rng.normal(0, along, (len(path_m), 1)))
    noisy[:, :2] += rng.normal(0, across_m, (len(path_m), 2))
    times_ns = ((start_s + np.arange(len(path_m)) / RATE_HZ) * NS_PER_S).astype(np.int64)
    return TimedPoints(times_ns, noisy)


def laid(*parts: tuple[float, float, float]) -> Array:
    """Return a path of parts: seconds, and speed in m/s along x and y."""
    steps = [np.tile([vx / RATE_HZ, vy / RATE_HZ, 0.0], (round(s * RATE_HZ), 1)) for s, vx, vy in parts]
    path_m: Array = np.array([-1.2, 0.6, 2.0]) + np.cumsum(np.concatenate(steps), axis=0)
    return path_m


def test_moved_marker_has_two_intervals() -> None:
    found = stationary_intervals({"red": seen(laid((5, 0, 0), (2, 0.4, 0.1), (4, 0, 0)))})
    assert [(round(a / NS_PER_S, 0), round(b / NS_PER_S, 0)) for a, b, _ in found] == [(0, 5), (7, 11)]


@pytest.mark.parametrize("speed_m_s", [0.01, 0.03, 0.1, 0.5])
def test_slow_marker_is_not_stationary(speed_m_s: float) -> None:
    assert stationary_intervals({"red": seen(laid((6, speed_m_s, speed_m_s / 3)))}) == []


def test_views_of_several_cameras_are_one_interval() -> None:
    path = laid((6, 0, 0), (1, 0.5, 0))
    cameras = {"red": seen(path), "white": seen(path[40:], 40 / RATE_HZ), "black": seen(path[:1])}
    (found,) = stationary_intervals(cameras)
    assert found[2] == ("red", "white")
    assert found[0] == 0
    assert found[1] == pytest.approx(6 * NS_PER_S, abs=0.1 * NS_PER_S)


def test_only_a_long_occlusion_splits_an_interval() -> None:
    path = laid((3, 0, 0))
    for gap_s, count in ((1.0, 1), (3.0, 2)):
        first, last = seen(path), seen(path, 3 + gap_s)
        joined = TimedPoints(
            np.concatenate([first.times_ns, last.times_ns]), np.concatenate([first.points_m, last.points_m])
        )
        assert len(stationary_intervals({"red": joined})) == count


def test_single_jump_does_not_split_an_interval() -> None:
    path = laid((8, 0, 0))
    path[100] += [0.05, 0, 0]
    (found,) = stationary_intervals({"red": seen(path)})
    assert found[:2] == (0, int(seen(path).times_ns[-1]))


def test_depth_noise_at_the_image_edge_is_no_motion() -> None:
    ray = np.array([-0.95, 0.55, 1.0])
    assert is_stationary(ray * np.array([[1.92], [1.921], [1.913]]))


def test_the_last_second_of_a_recording() -> None:
    def view(path: Array, camera: str = "red", first: int = 0) -> CameraView:
        rows = [CameraPoints(n, (CameraPoint(3, *point),)) for n, point in enumerate(path.tolist(), first)]
        return CameraView(camera, len(rows), points=tuple(rows))

    still, moves = laid((1, 0, 0)), laid((1, 0.05, 0))
    assert observe_marker([view(still)], 3).state == "still"
    assert observe_marker([view(still), view(moves, "white")], 3).moving == ("white",)
    assert observe_marker([view(still)], 4).state == "unseen"
    # A single observation gives no interval.
    assert observe_marker([view(still[:1])], 3).state == "unseen"
    # An earlier observation of another camera may be of another point.
    later = observe_marker([view(still, "white", 10), view(still[:10])], 3)
    assert later.still is not None
    assert (later.still.start, list(later.points_m)) == (10, ["white"])
    assert list(observe_marker([view(still, "white", 9), view(still[:10])], 3).points_m) == ["white", "red"]
