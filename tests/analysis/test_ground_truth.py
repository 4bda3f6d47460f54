"""Errors of tracks against the ground truth, at its times and between them."""

import numpy as np
import pytest

from ipsys_log.messages import Message, Track, Tracks
from ipsys_log.statistics.calibration_points import TimedPoints
from ipsys_log.statistics.ground_truth import gather_tracks, track_errors

MS = 1_000_000
# A double cannot hold nanoseconds since 1970 exactly.
START_NS = 1_700_000_000_000_000_001


def tracked(time_ms: float, x_m: float) -> Message:
    time_ns = START_NS + round(time_ms * MS)
    return Message("t", time_ns, time_ns, Tracks(time_ns, (Track("robot_0", 0, x_m, 0.0, 0.1),)))


TRUTH = gather_tracks([tracked(0, 0.0), tracked(30, 0.06), tracked(60, 0.06), tracked(161, 1.0)])


@pytest.mark.parametrize(
    ("time_ms", "x_m"), [(0, 0.0), (10, 0.02), (30, 0.06), (29.999999, 0.059999998), (45, 0.06), (161, 1.0)]
)
def test_ground_truth_is_interpolated_linearly(time_ms: float, x_m: float) -> None:
    found = track_errors(gather_tracks([tracked(time_ms, x_m + 0.25)]), TRUTH)
    assert found is not None
    assert found[0].mean_m == pytest.approx(0.25, abs=1e-12)


@pytest.mark.parametrize("time_ms", [-1e-6, 60 + 1e-6, 100, 161 + 1e-6])
def test_ground_truth_has_no_values_outside_its_times(time_ms: float) -> None:
    assert track_errors(gather_tracks([tracked(time_ms, 0.0)]), TRUTH) is None


def test_single_ground_truth_pose_is_not_extrapolated() -> None:
    truth = gather_tracks([tracked(0, 0.0)])
    assert track_errors(gather_tracks([tracked(1e-6, 0.0)]), truth) is None
    assert track_errors(gather_tracks([tracked(0, 0.0)]), truth) is not None


def test_poses_of_different_instants_count_one_by_one() -> None:
    # Two cameras expose a marker 4 ms apart: the second pose uses both, the first pose one.
    found = track_errors(gather_tracks([tracked(10, 0.02), tracked(14, 0.028), tracked(14, 0.038)]), TRUTH)
    assert found is not None
    assert found[0].count == 2
    assert found[0].max_m == pytest.approx(0.01)


def test_ground_truth_is_exact_at_its_own_times() -> None:
    rng = np.random.default_rng(0)
    times_ns = START_NS + np.sort(rng.choice(10_000 * MS, 300, replace=False))
    known = TimedPoints(times_ns[[0, *range(300)]], rng.normal(size=(301, 3)))
    there = np.sort(rng.choice(300, 200, replace=False))
    track = TimedPoints(times_ns[there], rng.normal(size=(200, 3)))
    found = track_errors({0: track}, {0: known})
    assert found is not None
    # The first of two poses at one time counts.
    rows_m = track.points_m - known.points_m[np.where(there == 0, 0, there + 1)]
    errors_m = np.linalg.norm(rows_m, axis=1)
    assert (found[0].count, found[0].mean_m) == (200, errors_m.mean())
    assert (found[0].min_m, found[0].max_m) == (errors_m.min(), errors_m.max())


def test_instants_at_other_heights_are_counted_and_shown() -> None:
    def lifted(time_ms: float, x_m: float, z_m: float) -> Message:
        time_ns = START_NS + round(time_ms * MS)
        return Message("t", time_ns, time_ns, Tracks(time_ns, (Track("robot_0", 0, x_m, 0.0, z_m),)))

    truth = gather_tracks([lifted(0, 0.0, 0.1), lifted(30, 0.0, 0.1), lifted(60, 0.0, 0.2)])
    tracks = gather_tracks([lifted(0, 0.001, 0.1), lifted(30, 0.003, 0.1), lifted(60, 0.1, 0.1)])
    found = track_errors(tracks, truth, at_track_height=True)
    assert found is not None
    assert (found.counted, found.instants, found.floor.count) == (2, 3, 2)
    assert found.floor.mean_m == pytest.approx(0.002)
    assert found.others is not None
    assert found.others[1].mean_m == pytest.approx(0.1)
    assert found.whole[1].mean_m == pytest.approx(0.104 / 3)
    every = track_errors(tracks, truth)
    assert every is not None
    assert (every.counted, every.others, every.floor) == (3, None, found.whole[1])
    none = track_errors({0: TimedPoints(tracks[0].times_ns[2:], tracks[0].points_m[2:])}, truth, True)
    assert none is not None
    assert none.counted == 0
    assert none.floor.mean_m == pytest.approx(0.1)
