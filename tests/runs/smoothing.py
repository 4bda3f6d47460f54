"""A stage for tests, in the form of a new stage: one file, one row, and one channel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from ipsys_log.messages import Message, Tracks
from ipsys_log.messages.channels import TRACKS, Channel
from ipsys_log.messages.stage import Plan, Stage, View

__all__ = ["SMOOTHED_TRACKS", "STAGE"]

SMOOTHED_TRACKS = Channel(name="smoothed_tracks", topic="/runs/{run}/smoothed_tracks", payloads=(Tracks,))


class Smooth:
    """Halve the distance between a pose and the pose before it."""

    def __init__(self, weight: float) -> None:
        self._weight = weight
        self._last: dict[str, float] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        tracks: Tracks = message.payload
        smoothed = []
        for track in tracks.tracks:
            x_m = self._weight * track.x_m + (1 - self._weight) * self._last.get(track.robot, track.x_m)
            self._last[track.robot] = x_m
            smoothed.append(replace(track, x_m=x_m))
        yield replace(tracks, tracks=tuple(smoothed))


def _plan(view: View, options: Mapping[str, str]) -> Plan:
    weight = options.get("weight", "0.5")
    return Plan(
        run=view.run(TRACKS),
        parameters={"weight": weight},
        reads=(TRACKS,),
        step=lambda run: Smooth(float(weight)),
    )


STAGE = Stage(
    name="smooth",
    versions={"smooth": 1},
    reads=(TRACKS,),
    writes=(SMOOTHED_TRACKS,),
    plan=_plan,
    rig_part=lambda rig: None,
    per_camera=False,
)
