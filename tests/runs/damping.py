"""A stage for tests, in the form of a new stage: one file, one entry, and one channel.

Run as a program, it is ``ipsys`` with this stage: ``python -m tests.runs.damping replay LOG``.
"""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from ipsys_log import stages
from ipsys_log.messages import Message, Tracks, channels
from ipsys_log.messages.channels import TRACKS, Channel
from ipsys_log.messages.stage import Plan, Stage, StageView
from ipsys_log.stages import StageEntry, StageParameter

DAMPED_TRACKS = Channel(name="damped_tracks", topic="/runs/{run}/damped_tracks", payloads=(Tracks,))
ENTRY = StageEntry(
    name="damp",
    help="Damp the tracks.",
    parameters=(StageParameter(name="weight", help="The weight of the newest pose.", metavar="W"),),
)


class Damp:
    """Halve the distance between a pose and the pose before it."""

    def __init__(self, weight: float) -> None:
        self._weight = weight
        self._last: dict[str, float] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        tracks: Tracks = message.payload
        damped = []
        for track in tracks.tracks:
            x_m = self._weight * track.x_m + (1 - self._weight) * self._last.get(track.robot, track.x_m)
            self._last[track.robot] = x_m
            damped.append(replace(track, x_m=x_m))
        yield replace(tracks, tracks=tuple(damped))


def _plan(view: StageView, options: Mapping[str, str]) -> Plan:
    weight = options.get("weight", "0.5")
    return Plan(
        run=view.run(TRACKS),
        parameters={"weight": weight},
        reads=(TRACKS,),
        step=lambda run: Damp(float(weight)),
    )


STAGE = Stage(
    name="damp",
    versions={"damp": 1},
    reads=(TRACKS,),
    writes=(DAMPED_TRACKS,),
    plan=_plan,
    rig_part=lambda rig, method: None,
    per_camera=False,
)


def _add_stage() -> None:
    """Add the stage to the tables of the program before it reads them, as its file would."""
    sys.modules[f"ipsys_log.stages.{ENTRY.module}"] = sys.modules[__name__]
    stages.ENTRIES = (*stages.ENTRIES, ENTRY)
    stages.STAGE_NAMES = (*stages.STAGE_NAMES, ENTRY.name)
    channels.CHANNELS = (*channels.CHANNELS, DAMPED_TRACKS)


if __name__ == "__main__":
    _add_stage()
    from ipsys_log.app.cli import main

    main()
