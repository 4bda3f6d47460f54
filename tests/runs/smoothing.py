"""A stage for tests, in the form of a new stage: one file, one entry, and one channel.

Run as a program, it is ``ipsys`` with this stage: ``python -m tests.runs.smoothing smooth LOG``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from ipsys_log import stages
from ipsys_log.messages import Message, Tracks, channels
from ipsys_log.messages.channels import TRACKS, Channel
from ipsys_log.messages.stage import Plan, Stage, StageView
from ipsys_log.stages import StageEntry, StageParameter

__all__ = ["ENTRY", "SMOOTHED_TRACKS", "STAGE"]

SMOOTHED_TRACKS = Channel(name="smoothed_tracks", topic="/runs/{run}/smoothed_tracks", payloads=(Tracks,))
ENTRY = StageEntry(
    name="smooth",
    help="Smooth the tracks.",
    parameters=(StageParameter(name="weight", help="The weight of the newest pose.", metavar="W"),),
)


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


def _plan(view: StageView, options: Mapping[str, str]) -> Plan:
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
    rig_part=lambda rig, method: None,
    per_camera=False,
)


def _add_stage() -> None:
    """Add the stage to the tables of the program before it reads them, as its file would."""
    sys.modules[f"ipsys_log.stages.{ENTRY.module}"] = sys.modules[__name__]
    stages.ENTRIES = (*stages.ENTRIES, ENTRY)
    channels.CHANNELS = (*channels.CHANNELS, SMOOTHED_TRACKS)


if __name__ == "__main__":
    _add_stage()
    from ipsys_log.cli import main

    main()
