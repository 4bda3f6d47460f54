"""Robots with several markers are one body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from ipsys_log.messages import Message, Position, Positions, Rig, RigMarker, Track, Tracks
from ipsys_log.stages.fuse import Fuse

ARM_M, TURN_RAD = np.array([0.3, -0.1]), 1.2
RIG = Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(1, robot="ada"), RigMarker(2, robot="ada")))


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
