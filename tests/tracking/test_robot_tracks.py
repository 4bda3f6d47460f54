"""Events of a day in the lab: what the track of a robot does in each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.messages import Message, Position, Positions, Rig, RigBody, RigMarker, Track, Tracks
from ipsys_log.models.tracking.tracks import Pose, RobotTracks, TrackSettings
from ipsys_log.stages.fuse import Fuse
from ipsys_log.units import NS_PER_S
from tests.tracking.driving import (
    CAMERAS,
    MS,
    START_NS,
    Sighting,
    circle,
    errors_m,
    follow,
    observe,
    place_of,
    sight,
)

Array = NDArray[np.float64]


def settled(poses: list[Pose]) -> list[Pose]:
    return [pose for pose in poses if pose.time_ns > START_NS + NS_PER_S // 2]


@pytest.mark.parametrize("speed_m_s", [0.26, 1.0])
def test_track_follows_a_bend_with_its_velocity(speed_m_s: float) -> None:
    def drive(time_ns: int) -> Array:
        return circle(time_ns, speed_m_s)

    poses = settled(follow(sight(drive, 3.0)))
    means = np.array([pose.states.means[pose.state] for pose in poses])
    true = np.array([(drive(pose.time_ns + MS) - drive(pose.time_ns - MS))[:2] for pose in poses]) * 500
    assert np.percentile(errors_m(poses, drive), 95) < 2.5e-4
    assert np.percentile(np.linalg.norm(means[:, 4:6] - true, axis=1), 95) < 0.02
    np.testing.assert_allclose(means[:, 7].mean(), speed_m_s / 0.5, rtol=0.01)
    assert {pose.cameras for pose in poses} == {tuple(sorted(CAMERAS))}


def test_each_instant_of_a_robot_has_one_pose() -> None:
    together = [replace(one, time_ns=one.time_ns // (33 * MS) * 33 * MS) for one in sight(circle, 1.0)]
    together = [replace(one, pose=circle(one.time_ns)) for one in together]
    poses = follow(together)
    times_ns = [pose.time_ns for pose in poses]
    assert len(times_ns) == len(set(times_ns))
    assert set(times_ns) == {one.time_ns for one in together}
    # The later cameras of an instant are in the next pose.
    assert poses[0].cameras == ("red",)
    assert poses[-1].cameras == tuple(sorted(CAMERAS))


def last_states(sightings: list[Sighting]) -> Array:
    tracks = RobotTracks()
    follow(sightings, tracks=tracks)
    (pose,) = tracks.coast(max(one.time_ns for one in sightings) + 200 * MS)
    return np.concatenate([pose.states.means[pose.state], pose.states.covariances[pose.state].ravel()])


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(0, 200), min_size=30, max_size=30))
def test_late_sightings_give_the_same_track_as_in_time(delays_ms: list[int]) -> None:
    in_time = sight(circle, 0.4)
    arrivals = [one.time_ns + delay * MS for one, delay in zip(in_time, delays_ms + [0] * 6, strict=True)]
    order = sorted(range(len(in_time)), key=lambda row: arrivals[row])
    np.testing.assert_allclose(
        last_states([in_time[row] for row in order]), last_states(in_time), rtol=1e-6, atol=1e-12
    )


def test_pose_that_was_given_out_stays_and_later_ones_know_the_late_sighting() -> None:
    sightings = sight(circle, 1.0)
    late = sightings.pop(-10)
    tracks = RobotTracks()
    before = follow(sightings[:-4], tracks=tracks)
    kept = [place_of(pose).copy() for pose in before]
    (own,) = observe(tracks, late)
    assert own.time_ns == late.time_ns
    np.testing.assert_array_equal([place_of(pose) for pose in before], kept)
    after = follow(sightings[-4:], tracks=tracks)[-1]
    without = follow(sightings)[-1]
    assert np.abs(place_of(after) - place_of(without)).max() > 1e-9
    np.testing.assert_allclose(place_of(after), place_of(without), atol=1e-3)


def test_sighting_older_than_half_a_second_is_left_out() -> None:
    sightings = sight(circle, 1.0)
    tracks = RobotTracks()
    last = follow(sightings[1:], tracks=tracks)[-1]
    assert list(observe(tracks, sightings[0])) == []
    assert last.time_ns - sightings[0].time_ns > NS_PER_S // 2


def test_time_in_the_future_stops_a_track_for_two_frames() -> None:
    sightings = sight(circle, 2.0)
    wrong = replace(sightings[60], time_ns=sightings[60].time_ns + 3600 * NS_PER_S)
    poses = follow([*sightings[:60], wrong, *sightings[61:]])
    assert len(poses) == len(sightings) - 2
    assert errors_m([pose for pose in poses if pose.time_ns < wrong.time_ns], circle).max() < 1e-3


def moved(one: Sighting, by: Array) -> Sighting:
    return replace(one, pose=one.pose + by)


@pytest.mark.parametrize(
    "fault",
    [
        np.array([1.5, -0.8, 0.0, 2.0]),  # the id of another marker
        np.array([0.03, 0.02, 0.01, 0.1]),  # the mirrored pose of the square
    ],
)
def test_fault_of_one_frame_does_not_move_the_track(fault: Array) -> None:
    sightings = sight(circle, 2.0)
    faulty = [moved(one, fault) if row == 120 else one for row, one in enumerate(sightings)]
    poses = follow(faulty)
    assert sightings[120].time_ns not in {pose.time_ns for pose in poses}
    assert errors_m(settled(poses), circle).max() < 6e-4


def test_robot_put_down_elsewhere_is_tracked_again_at_once() -> None:
    lifted_ns = START_NS + NS_PER_S

    def drive(time_ns: int) -> Array:
        far = np.array([1.2, -0.7, 0.0, 0.0]) if time_ns >= lifted_ns else np.zeros(4)
        return circle(time_ns) + far

    poses = follow(sight(drive, 2.0))
    after = [pose for pose in poses if pose.time_ns >= lifted_ns]
    assert after[0].time_ns - lifted_ns < 50 * MS
    assert errors_m(after, drive).max() < 1e-3


def test_robot_lifted_slowly_and_put_down_is_never_lost() -> None:
    def drive(time_ns: int) -> Array:
        since_s = (time_ns - START_NS) / NS_PER_S
        lift_m = min(max(min(since_s - 1, 3 - since_s), 0.0), 0.5)
        way_m = 0.8 * min(max(since_s - 1, 0.0), 2.0)
        pose: Array = circle(START_NS) + np.array([way_m, 0.3 * lift_m, lift_m, 0.0])
        return pose

    poses = follow(sight(drive, 4.0))
    times_ns = [pose.time_ns for pose in poses]
    assert max(np.diff(times_ns)) < 100 * MS
    assert errors_m([poses[-1]], drive)[0] < 1e-3


def covered(seconds: float, from_s: float = 1.0) -> Callable[[Sighting], bool]:
    def is_seen(one: Sighting) -> bool:
        since_s = (one.time_ns - START_NS) / NS_PER_S
        return one.robot != "ada" or not from_s <= since_s < from_s + seconds

    return is_seen


def with_another(sightings: list[Sighting]) -> list[Sighting]:
    """Add a robot that stands in the corner: its sightings carry the time on."""
    still = sight(lambda time_ns: np.array([0.5, 0.5, 0.1, 0.0]), 6.0, robot="bob", seed=9)
    return sorted([*sightings, *still], key=lambda one: (one.time_ns, one.robot))


def test_covered_robot_coasts_with_growing_covariance_and_ends() -> None:
    sightings = with_another([one for one in sight(circle, 6.0) if covered(3.0)(one)])
    poses = [pose for pose in follow(sightings) if pose.robot[0] == "ada"]
    coasting = [pose for pose in poses if pose.coasting_ns is not None]
    sizes = [np.trace(pose.states.covariances[pose.state, :2, :2]) for pose in coasting]
    assert (np.diff(sizes) > 0).all()
    ages_s = np.array([pose.coasting_ns or 0 for pose in coasting]) / NS_PER_S
    assert 0.1 < ages_s.min() < 0.12
    assert 0.97 < ages_s.max() <= 1.0
    # The errors of the prediction agree with its covariance.
    errors = np.array([(place_of(pose) - circle(pose.time_ns)[:3])[:2] for pose in coasting])
    spreads = np.array([pose.states.covariances[pose.state, :2, :2] for pose in coasting])
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(spreads), errors)
    assert squares.max() < 9.2
    back_ns = START_NS + 4 * NS_PER_S
    after = [pose for pose in poses if pose.time_ns >= back_ns]
    assert after[0].time_ns - back_ns < 34 * MS
    assert errors_m(after[3:], circle).max() < 1e-3


@pytest.mark.parametrize(("speed_m_s", "braking_m_s2"), [(0.26, 0.8), (1.0, 2.0)])
def test_robot_that_brakes_while_unseen_is_in_the_region(speed_m_s: float, braking_m_s2: float) -> None:
    covered_ns = START_NS + NS_PER_S

    def drive(time_ns: int) -> Array:
        seen_s = (min(time_ns, covered_ns) - START_NS) / NS_PER_S
        braking_s = min(max(time_ns - covered_ns, 0) / NS_PER_S, speed_m_s / braking_m_s2)
        x_m = speed_m_s * (seen_s + braking_s) - braking_m_s2 / 2 * braking_s**2
        return np.array([1 + x_m, 2.0, 0.1, 0.0])

    tracks = RobotTracks()
    follow([one for one in sight(drive, 1.0) if one.time_ns < covered_ns], tracks=tracks)
    squares = []
    for later_ms in range(150, 900, 50):
        (pose,) = tracks.coast(covered_ns + later_ms * MS)
        missed_m = place_of(pose)[:2] - drive(pose.time_ns)[:2]
        spread_m2 = pose.states.covariances[pose.state, :2, :2]
        squares.append(missed_m @ np.linalg.solve(spread_m2, missed_m))
    # The limit of the 95 % region.
    assert max(squares) < 5.99, squares


@pytest.mark.parametrize(("seen", "longest_s"), [(1, 0.0), (2, 0.0), (3, 1.0)])
def test_robot_seen_once_or_twice_is_not_predicted(seen: int, longest_s: float) -> None:
    rows = follow(with_another(sight(circle, 1.0)[:seen]))
    ages_ns = [pose.coasting_ns or 0 for pose in rows if pose.robot[0] == "ada"]
    assert max(ages_ns) == pytest.approx(longest_s * NS_PER_S, abs=0.04 * NS_PER_S)


def test_young_track_gives_way_to_the_next_sighting_elsewhere() -> None:
    """A marker that is carried between points, with two frames at each, is never seen between them."""
    frames = [one for one in sight(circle, 4.0) if one.camera == "red"][:4]
    moved = [
        replace(one, pose=one.pose + np.array([1.5 * (n // 2), 0, 0, 0])) for n, one in enumerate(frames)
    ]
    xs_m = [pose.states.means[pose.state, 0] for pose in follow(moved)]
    assert len(xs_m) == 3
    assert xs_m == pytest.approx([one.pose[0] for one in (moved[0], moved[1], moved[3])], abs=0.01)


def test_coasting_time_is_a_setting() -> None:
    sightings = with_another([one for one in sight(circle, 6.0) if covered(3.0)(one)])
    poses = follow(sightings, TrackSettings(coast_ns=2 * NS_PER_S, coast_m=5.0))
    assert max(pose.coasting_ns or 0 for pose in poses) > 1.97 * NS_PER_S


def test_one_covered_camera_of_three_leaves_no_gap() -> None:
    sightings = [one for one in sight(circle, 5.0) if one.camera != "red" or covered(3.0)(one)]
    poses = settled(follow(sightings))
    assert errors_m(poses, circle).max() < 6e-4
    assert all(pose.coasting_ns is None for pose in poses)
    assert {pose.cameras for pose in poses} == {("black", "white"), tuple(sorted(CAMERAS))}


def test_two_robots_that_pass_at_25_cm_keep_their_tracks() -> None:
    def other(time_ns: int) -> Array:
        since_s = (time_ns - START_NS) / NS_PER_S
        return np.array([2.75, 2.3 - 0.26 * since_s, 0.1, -np.pi / 2])

    sightings = sorted(
        [*sight(circle, 2.0), *sight(other, 2.0, robot="bob", seed=1)],
        key=lambda one: (one.time_ns, one.robot),
    )
    poses = settled(follow(sightings))
    drives = {"ada": circle, "bob": other}
    apart_m = min(np.linalg.norm((circle(t.time_ns) - other(t.time_ns))[:2]) for t in poses)
    assert 0.2 < apart_m < 0.27
    for robot, drive in drives.items():
        assert errors_m([pose for pose in poses if pose.robot[0] == robot], drive).max() < 6e-4


def test_knocked_camera_is_left_out_beside_another_one() -> None:
    """One degree at 2.1 m is 37 mm on the floor."""
    knocked_ns, shift = START_NS + NS_PER_S, np.array([0.037, 0.0, 0.0, 0.0])
    sightings = [
        moved(one, shift) if one.camera == "red" and one.time_ns >= knocked_ns else one
        for one in sight(circle, 3.0)
    ]
    poses = settled(follow(sightings))
    assert errors_m(poses, circle).max() < 6e-4
    assert {pose.cameras for pose in poses if pose.time_ns > knocked_ns + 200 * MS} == {("black", "white")}


def test_knocked_camera_alone_moves_the_track_in_one_step() -> None:
    knocked_ns, shift = START_NS + NS_PER_S, np.array([0.037, 0.0, 0.0, 0.0])
    sightings = [
        moved(one, shift) if one.time_ns >= knocked_ns else one for one in sight(circle, 3.0, ("red",))
    ]
    poses = follow(sightings)
    after = [pose for pose in poses if pose.time_ns > knocked_ns]
    assert after[0].time_ns - knocked_ns < 120 * MS
    np.testing.assert_allclose(
        [place_of(p) - circle(p.time_ns)[:3] for p in after], [shift[:3]] * len(after), atol=1e-3
    )


def test_same_marker_twice_in_a_frame_uses_the_one_on_the_track() -> None:
    from tests.tracking.driving import arrays

    tracks = RobotTracks()
    follow(sight(circle, 1.0), tracks=tracks)
    time_ns = START_NS + NS_PER_S + 50 * MS
    twice = arrays([circle(time_ns) + np.array([1.0, 0.0, 0.0, 0.0]), circle(time_ns)])
    poses = tracks.observe("red", [("ada", 0)] * 2, [time_ns] * 2, twice, [None] * 2, [True] * 2)
    assert len(poses) == 1
    assert errors_m(poses, circle)[0] < 1e-3


def test_slow_synchronised_cameras_predict_no_robot_that_one_of_them_sees() -> None:
    """The frame of the camera that does not see the robot arrives first, at each instant."""
    tracks = RobotTracks()
    poses: list[Pose] = []
    for number in range(12):
        time_ns = START_NS + number * NS_PER_S // 4
        poses += tracks.coast_before(time_ns)
        poses += observe(tracks, Sighting(time_ns, "red", circle(time_ns, 0.26)))
    assert len(poses) == 12
    assert {pose.coasting_ns for pose in poses} == {None}


def test_complete_history_keeps_all_sightings_but_few_states() -> None:
    sightings = sight(circle, 2.0)
    tracks = RobotTracks(complete=True)
    follow(sightings, tracks=tracks)
    ((_, history),) = tracks.histories()
    assert [one.time_ns for one in history.everything()] == [one.time_ns for one in sightings]
    # Only a late sighting needs states: those of half a second.
    assert len(history.records) < len(sightings) / 3


ARM_M, TURN_RAD = np.array([0.3, -0.1]), 1.2
RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    (RigMarker(1, robot="ada"), RigMarker(2, robot="ada")),
    bodies=(RigBody("ada", level=True),),
)


def positions_at(time_ns: int, ids: tuple[int, ...]) -> Positions:
    """Return the markers of a robot that drives a bend; marker 2 is ``ARM_M`` from marker 1."""
    angle = 1.0 * time_ns / 1e9
    places = {1: (2 + np.cos(angle), 2 + np.sin(angle), angle)}
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    x_m, y_m = np.array(places[1][:2]) + turn @ ARM_M
    places[2] = (x_m, y_m, angle + TURN_RAD)
    wrapped = {n: (x, y, (a + np.pi) % (2 * np.pi) - np.pi) for n, (x, y, a) in places.items()}
    return Positions(
        time_ns, tuple(Position(n, *wrapped[n][:2], 0.1, wrapped[n][2], 1e-8 * np.eye(3)) for n in ids)
    )


def tracks_of(frames: Sequence[tuple[int, ...]]) -> list[tuple[int, Track]]:
    fuse = Fuse("poly")
    list(fuse(Message("/rig", 0, 0, RIG)))
    made: list[Any] = []
    for number, ids in enumerate(frames):
        time_ns = number * 33_000_000
        made += fuse(Message("t", time_ns, time_ns, positions_at(time_ns, ids), "red"))
    return [(one.timestamp, track) for one in made if isinstance(one, Tracks) for track in one.tracks]


def test_robot_with_two_markers_has_one_track() -> None:
    rows = tracks_of([(1, 2)] * 40)
    assert len(rows) == 40
    assert {(track.robot, track.id) for _, track in rows} == {("ada", 1)}


def test_covered_reference_is_replaced_by_the_other_marker() -> None:
    rows = tracks_of([(1, 2)] * 30 + [(2,)] * 30)
    assert len(rows) == 60
    for time_ns, track in rows[30:]:
        (expected,) = positions_at(time_ns, (1,)).positions
        assert (track.x_m, track.y_m) == pytest.approx((expected.x_m, expected.y_m), abs=1e-3)
        assert track.heading_rad == pytest.approx(expected.heading_rad, abs=0.01)
        assert track.coasting_ns is None


def test_marker_of_unknown_place_does_not_move_the_robot() -> None:
    rows = tracks_of([(1,)] * 20 + [(2,)] * 20)
    assert [track.coasting_ns is None for _, track in rows[:20]] == [True] * 20
    assert all(track.coasting_ns is not None for _, track in rows[20:])


def test_pivot_of_level_and_of_free_body_is_tracked() -> None:
    """Both bodies stand still; the oracle is a product of poses."""
    pivot_m = (0.1, -0.2, -0.3)
    markers = (RigMarker(1, robot="ada"), RigMarker(2, robot="eve"))
    bodies = (RigBody("ada", True, pivot_m, (0.0, 0.0, 0.5)), RigBody("eve", False, pivot_m, (0.1, 0.2, 0.3)))
    turn = Rotation.from_rotvec([0.3, -0.2, 2.0])
    level = Rotation.from_euler("z", 2.5)
    noise = np.diag(np.repeat([1e-4, 1e-3], 3) ** 2)
    seen = (
        Position(1, 1.0, 2.0, 0.4, 2.5, 1e-8 * np.eye(3), heading_noise_rad=1e-3),
        Position(2, 1.0, 2.0, 0.4, 0.0, 1e-8 * np.eye(3), rotation_rad=turn.as_rotvec(), still_noise=noise),
    )
    fuse = Fuse("joint")
    list(fuse(Message("/rig", 0, 0, Rig("lab", "DICT_4X4_100", 0.2, markers, bodies=bodies))))
    made = list(fuse(Message("t", 1, 1, Positions(1, seen), "red")))
    ada, eve = made[0].tracks
    for track, own, axes in ((ada, level, "z"), (eve, turn, "xyz")):
        expected_m = np.array([1.0, 2.0, 0.4]) + own.apply(pivot_m)
        assert np.abs([track.x_m, track.y_m, track.z_m] - expected_m).max() < 1e-9
        turned = own * Rotation.from_euler(axes, 0.5 if axes == "z" else [0.1, 0.2, 0.3])
        assert np.cos(track.heading_rad - turned.as_euler("ZYX")[0]) == pytest.approx(1.0)
    assert (Rotation.from_rotvec(eve.rotation_rad).inv() * turned).magnitude() < 1e-9
    # A turn moves the pivot: its point is less certain than that of the body.
    lever = np.cross(np.eye(3), turn.apply(pivot_m))
    by_pose = np.block([[np.eye(3), lever.T], [np.zeros((3, 3)), np.eye(3)]])
    expected = by_pose @ noise @ by_pose.T + 1e-8 * np.eye(6)
    np.testing.assert_allclose(eve.pose_covariance, expected, rtol=0.02, atol=1e-9)
    assert made[1].transforms[1].rotation.w == pytest.approx(abs(turned.as_quat()[3]))


@pytest.mark.parametrize(
    "wrong",
    [
        {"rotation_rad": np.array([np.nan, 0.0, 0.0])},
        {"still_noise": np.full((6, 6), np.nan)},
        {"still_noise": -np.eye(6)},
        {"error_modes": np.ones(5)},
        {"error_modes": np.full(14, np.inf)},
        {"to_still": np.full(6, np.nan)},
        {"still_by_motion": np.full((6, 6), 1e300)},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_free_body_of_a_hostile_log_gives_finite_tracks(wrong: dict[str, Any]) -> None:
    rig = Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(1, robot="eve"),), bodies=(RigBody("eve", False),))
    own = Position(1, 1.0, 2.0, 0.4, rotation_rad=np.zeros(3), still_noise=1e-6 * np.eye(6))
    fuse = Fuse("joint")
    list(fuse(Message("/rig", 0, 0, rig)))
    made: list[Any] = []
    for number, position in enumerate((own, replace(own, **wrong), own)):
        time_ns = number * 33_000_000
        made += fuse(Message("t", time_ns, time_ns, Positions(time_ns, (position,)), "red"))
    tracks = [track for one in made if isinstance(one, Tracks) for track in one.tracks]
    assert len(tracks) == 3 - ("rotation_rad" in wrong)
    for track in tracks:
        assert np.isfinite([track.x_m, track.y_m, track.z_m]).all()
        assert np.isfinite(np.array(track.rotation_rad, dtype=np.float64)).all()
        assert track.pose_covariance is None or np.linalg.eigvalsh(track.pose_covariance)[0] > 0
