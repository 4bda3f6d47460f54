"""Positions from late frames are in no pose."""

from __future__ import annotations

from collections.abc import Sequence

from ipsys_log.engine.stream import run, wire
from ipsys_log.messages import (
    EVENTS_TOPIC,
    RIG_TOPIC,
    STAMP_UNRELIABLE,
    Event,
    Message,
    Position,
    Positions,
    Rig,
    Tracks,
)
from ipsys_log.messages.channels import POSITIONS
from ipsys_log.stages import fuse


def place(time_ns: int, camera: str = "red") -> Message:
    positions = Positions(time_ns, (Position(1, 1.0, 2.0, 0.0),))
    return Message(f"/runs/poly/cameras/{camera}/positions", time_ns, time_ns, positions, camera)


def late(time_ns: int, start_ns: int, end_ns: int | None = None, kind: str = STAMP_UNRELIABLE) -> Message:
    event = Event(time_ns, kind, "", "red", None, start_ns, end_ns)
    return Message(EVENTS_TOPIC, time_ns, time_ns, event)


def times_of_tracks(messages: Sequence[Message]) -> list[int]:
    rig = Message(RIG_TOPIC, 0, 0, Rig("lab", "DICT_4X4_100", 0.2))
    made = run([rig, *messages], [wire(fuse.STAGE, "poly", {POSITIONS: "poly"}, fuse.Fuse("poly"))])
    return [message.payload.timestamp for message in made if isinstance(message.payload, Tracks)]


def test_late_frames_have_no_tracks() -> None:
    messages = [place(10), late(50, 20), place(60), place(80), late(90, 20, 80), place(100)]
    assert times_of_tracks(messages) == [10, 100]


def test_late_frames_without_an_end_have_no_tracks_to_the_end() -> None:
    assert times_of_tracks([place(10), late(50, 20), place(60), place(10**12)]) == [10]


def test_other_cameras_and_other_events_change_nothing() -> None:
    messages = [late(5, 0, kind="camera_lost"), place(10), late(50, 20), place(60), place(61, "white")]
    assert times_of_tracks(messages) == [10, 61]


def test_late_frame_is_not_averaged_into_another_camera() -> None:
    far = Positions(61, (Position(1, 9.0, 9.0, 0.0),))
    other = Message("/runs/poly/cameras/white/positions", 61, 61, far, "white")
    rig = Message(RIG_TOPIC, 0, 0, Rig("lab", "DICT_4X4_100", 0.2))
    stage = wire(fuse.STAGE, "poly", {POSITIONS: "poly"}, fuse.Fuse("poly"))
    made = run([rig, late(50, 20), place(60), other], [stage])
    (tracks,) = (message.payload for message in made if isinstance(message.payload, Tracks))
    assert (tracks.tracks[0].x_m, tracks.tracks[0].cameras) == (9.0, ("white",))
