"""Moves of cameras over weeks: which camera, when, and how much; and markers that moved themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Floor
from ipsys_log.statistics.camera_moves import DriftLog, LabDrift, Window, find_drift
from ipsys_log.statistics.drift import MeanCorners
from ipsys_log.statistics.floor_cameras import floor_grid, shift_floor_map
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import in_image, project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import PosedCamera, pose_facing_up, transform

Array = NDArray[np.float64]

PLACES = {90: (1.0, 1.62), 91: (3.9, 1.62), 92: (1.0, 3.25), 93: (3.9, 3.25), 94: (2.4, 2.45)}
FLOOR = Floor(4.88, 4.88)
WEEK_NS = 7 * 24 * 3600 * NS_PER_S
WINDOWS = 6
LENGTH_M = 0.2
KNOCK = np.array([0.0006, 0.0012, 0.0003, 0.0, 0.0, 0.0])

CAMERAS = {
    one.name: PosedCamera.at_pose(one.name, one.lens, one.camera_from_world)
    for one in mount_cameras(LabSettings(seed=3))
}
Motions = Callable[[str, int, int], Array]


def still(_camera: str, _week: int, _number: int) -> Array:
    return np.zeros(6)


def log(week: int, motions: Motions, places: Mapping[int, tuple[float, float]] = PLACES) -> DriftLog:
    """Return the log of a week, with slow changes of light and noise."""
    rng = np.random.default_rng([week, 8])
    light_px = {(camera, one): rng.normal(0, 0.04, 2) for camera in CAMERAS for one in places}
    windows = []
    for number in range(WINDOWS):
        start_ns = week * WEEK_NS + number * NS_PER_S
        seen: dict[str, dict[int, MeanCorners]] = {}
        for name, camera in CAMERAS.items():
            moved = camera.move(motions(name, week, number))
            for marker_id, (x_m, y_m) in places.items():
                placed_m = transform(pose_facing_up(x_m, y_m, 0.0, 0.3), marker_corners(LENGTH_M))
                if in_image(moved.transform(placed_m), moved.lens).all():
                    px = project(moved.transform(placed_m), moved.lens) + light_px[name, marker_id]
                    px += rng.normal(0, 0.006, (4, 2))
                    seen.setdefault(name, {})[marker_id] = MeanCorners(px, 10)
        windows.append(Window(start_ns, start_ns + NS_PER_S, seen))
    return DriftLog(f"week{week}", windows)


def find(logs: list[DriftLog]) -> LabDrift:
    return find_drift(logs, CAMERAS, dict.fromkeys(PLACES, LENGTH_M), FLOOR)


def mean_shift_m(camera: str, motion: Array) -> float:
    own = CAMERAS[camera]
    return float(np.linalg.norm(shift_floor_map(own, floor_grid(own, FLOOR), motion), axis=1).mean())


def test_camera_knocked_between_logs_is_found() -> None:
    def knocked(camera: str, week: int, _number: int) -> Array:
        return KNOCK if camera == "white" and week >= 5 else np.zeros(6)

    drift = find([log(week, knocked) for week in range(1, 8)])
    assert [(move.camera, move.before, move.after) for move in drift.moves] == [("white", "week4", "week5")]
    (move,) = drift.moves
    assert not move.gradual
    assert abs(move.motion.mean_shift_m - mean_shift_m("white", KNOCK)) < 3 * move.motion.sigma_m
    moved = {(state.camera, state.log) for state in drift.states if state.motion and state.motion.is_moved}
    assert moved == {("white", "week5"), ("white", "week6"), ("white", "week7")}


def test_camera_knocked_within_a_log_is_found_to_the_second() -> None:
    def knocked(camera: str, week: int, number: int) -> Array:
        return KNOCK if camera == "red" and (week, number) >= (2, 3) else np.zeros(6)

    (move,) = find([log(week, knocked) for week in (1, 2, 3)]).moves
    assert (move.camera, move.before, move.after) == ("red", "week2", "week2")
    at_ns = 2 * WEEK_NS + 3 * NS_PER_S
    assert move.before_ns <= at_ns <= move.after_ns <= at_ns + NS_PER_S


def test_two_knocks_of_one_camera_are_two_moves() -> None:
    def knocked(camera: str, week: int, _number: int) -> Array:
        return (week >= 2) * KNOCK + (week >= 4) * 2 * KNOCK if camera == "black" else np.zeros(6)

    drift = find([log(week, knocked) for week in range(1, 6)])
    assert [(move.camera, move.after) for move in drift.moves] == [("black", "week2"), ("black", "week4")]
    last = drift.of_camera("black")[-1].motion
    assert last is not None
    assert abs(last.mean_shift_m - mean_shift_m("black", 3 * KNOCK)) < 3 * last.sigma_m


def test_still_cameras_have_no_move() -> None:
    drift = find([log(week, still) for week in range(1, 7)])
    assert (drift.moves, drift.marker_moves) == ([], [])


def test_marker_seen_to_move_by_two_cameras_is_no_camera_move() -> None:
    shifted = {**PLACES, 94: (2.41, 2.45)}
    drift = find([log(1, still), log(2, still, shifted), log(3, still, shifted)])
    assert drift.moves == []
    assert [(move.marker_id, move.log) for move in drift.marker_moves] == [(94, "week2")]
    assert all(state.motion and 94 in state.motion.markers for state in drift.of_camera("white"))
    assert not any(state.motion.is_moved for state in drift.states if state.motion)


def test_only_marker_of_two_cameras_that_moves_accuses_none() -> None:
    one, moved = {90: PLACES[90]}, {90: (1.01, 1.62)}
    drift = find([log(1, still, one), log(2, still, moved), log(3, still, moved)])
    assert drift.moves == []
    assert [(move.marker_id, move.log) for move in drift.marker_moves] == [(90, "week2")]


@pytest.mark.slow
def test_slow_sag_is_one_gradual_move() -> None:
    def sagging(camera: str, week: int, _number: int) -> Array:
        return 0.15 * week * KNOCK if camera == "red" else np.zeros(6)

    moves = find([log(week, sagging) for week in range(1, 10)]).moves
    assert moves
    assert {move.camera for move in moves} == {"red"}
    assert moves[0].gradual


def test_marker_that_is_added_later_is_used() -> None:
    def knocked(camera: str, week: int, _number: int) -> Array:
        return KNOCK if camera == "red" and week >= 4 else np.zeros(6)

    few = {one: PLACES[one] for one in (90,)}
    logs = [log(1, knocked, few), *(log(week, knocked) for week in (2, 3, 4))]
    (move,) = find(logs).moves
    assert (move.camera, move.after) == ("red", "week4")
    assert len(move.motion.markers) > 1
