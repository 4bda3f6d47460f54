"""Smoothed tracks of a log: their order, their accuracy, and their beginning and end."""

from __future__ import annotations

import random
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.log.codec import encode
from ipsys_log.messages import Position, Rig, RigMarker, Track, Tracks
from ipsys_log.models.tracking import smoothed_poses
from ipsys_log.models.tracking.smoothed_poses import Frame, SmoothedPose, smooth_positions, smooth_track
from ipsys_log.models.tracking.track_messages import make_track
from ipsys_log.units import NS_PER_S

Array = NDArray[np.float64]

RIG = Rig(name="lab", dictionary="DICT_4X4_50", marker_length_m=0.2, markers=(RigMarker(7, robot="ada"),))
STEP_NS, NOISE_M = 11_000_000, 0.002
SIGMAS_M2 = NOISE_M**2 * np.eye(3)


def drive(times_ns: NDArray[np.int64], jump_ns: int | None = None) -> Array:
    """Return x and y (n, 2) on a circle of 1 m at 0.5 m/s; after the jump, the robot is 1.5 m away."""
    angles = 0.5 * times_ns / NS_PER_S
    points_m = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    if jump_ns is not None:
        points_m[times_ns >= jump_ns, 0] += 1.5
    return points_m


def make_frames(count: int, seed: int = 1, jump_ns: int | None = None) -> tuple[list[Frame], Array]:
    """Return frames of two cameras that take turns, with noise, and the true points."""
    rng = np.random.default_rng(seed)
    times_ns = STEP_NS * np.arange(count, dtype=np.int64)
    points_m = drive(times_ns, jump_ns)
    frames = []
    for n, time_ns in enumerate(times_ns.tolist()):
        x_m, y_m, z_m = (*points_m[n], 0.1) + NOISE_M * rng.normal(size=3)
        position = Position(7, x_m, y_m, z_m, None, SIGMAS_M2, True)
        frames.append(Frame(time_ns, ("red", "white")[n % 2], time_ns + 5, (position,)))
    return frames, points_m


def rows(poses: list[SmoothedPose]) -> list[Track]:
    return [make_track(one.pose) for one in poses]


def test_rows_do_not_depend_on_the_order_of_the_frames() -> None:
    frames, _ = make_frames(60)
    mixed = frames.copy()
    random.Random(4).shuffle(mixed)
    first, second = (
        [
            encode(Tracks(one.pose.time_ns, (make_track(one.pose),)))
            for one in smooth_positions(order, RIG, None)
        ]
        for order in (frames, mixed)
    )
    assert first == second
    assert len(first) == 60


def test_smoothed_error_is_a_third_of_a_position() -> None:
    frames, points_m = make_frames(300)
    poses = smooth_positions(frames, RIG, None)
    errors_m = np.array([(t.x_m, t.y_m) for t in rows(poses)]) - points_m
    assert np.sqrt((errors_m**2).mean()) < NOISE_M / 3
    middle = slice(50, -50)
    covariances = np.array([track.covariance_m2 for track in rows(poses)])[middle, :2, :2]
    chi2 = (errors_m[middle] * np.linalg.solve(covariances, errors_m[middle, :, None])[:, :, 0]).sum(axis=1)
    assert 0.2 < chi2.mean() / 2 < 2.0
    velocities = np.array([track.velocity_m_s for track in rows(poses)])[middle, :2]
    true_m_s = 0.5 * np.stack([-points_m[middle, 1], points_m[middle, 0]], axis=1)
    assert np.percentile(np.linalg.norm(velocities - true_m_s, axis=1), 95) < 0.03


def test_robot_that_is_carried_away_begins_a_new_track() -> None:
    jump_ns = 100 * STEP_NS
    frames, points_m = make_frames(200, jump_ns=jump_ns)
    poses = smooth_positions(frames, RIG, None)
    ages_ns = [track.age_ns for track in rows(poses)]
    assert ages_ns[0] == ages_ns[100] == 0
    assert ages_ns[99] == 99 * STEP_NS
    errors_m = np.array([(t.x_m, t.y_m) for t in rows(poses)]) - points_m
    # The jump has no effect on either side.
    assert np.abs(errors_m).max() < 4 * NOISE_M


def test_wrong_position_of_one_frame_is_left_out() -> None:
    frames, points_m = make_frames(100)
    (position,) = frames[50].positions
    frames[50] = frames[50]._replace(
        positions=(Position(7, 3.0, 3.0, 0.1, None, position.covariance_m2, True),)
    )
    poses = smooth_positions(frames, RIG, None)
    assert [one.pose.time_ns for one in poses] == [
        frame.time_ns for frame in frames if frame is not frames[50]
    ]
    errors_m = np.array([(t.x_m, t.y_m) for t in rows(poses)]) - np.delete(points_m, 50, axis=0)
    assert np.abs(errors_m).max() < 4 * NOISE_M


def test_no_frame_gives_no_pose() -> None:
    assert smooth_positions([], RIG, None) == []
    assert smooth_positions([Frame(1, "red", 2, ())], RIG, None) == []


def test_progress_counts_the_filter_and_each_smoothed_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive of an hour has one track: a bar without steps between its beginning and its end would stand."""
    frames, _ = make_frames(120)
    monkeypatch.setattr(smoothed_poses, "smooth_track", partial(smooth_track, block=20))
    shares: list[float] = []
    smooth_positions(frames, RIG, None, progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    # Half of the work is the filter, frame by frame; then six blocks are filtered, and six smoothed.
    assert shares[:120] == pytest.approx(list(np.arange(1, 121) / 240))
    assert shares[120:] == pytest.approx(list(0.5 + np.arange(1, 13) / 24))
