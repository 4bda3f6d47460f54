"""Inputs of the stages that track robots: their channels, and the part of the rig."""

from __future__ import annotations

from ipsys_log.messages import STAMP_UNRELIABLE, Model, Rig
from ipsys_log.messages.channels import EVENTS, MODEL, POSITIONS, RIG, Channel
from ipsys_log.messages.stage import StageView

__all__ = ["TRACK_READS", "model_of", "track_reads", "tracked_part"]

TRACK_READS = (RIG, POSITIONS, MODEL, EVENTS)


def model_of(view: StageView) -> Model | None:
    """Return the model of the positions; None for positions of another program."""
    models = view.payloads(MODEL) if view.run(MODEL) else []
    return models[-1] if models else None


def track_reads(view: StageView) -> tuple[Channel, ...]:
    """Return the channels of ``TRACK_READS`` on which the tracks of a log depend.

    A log without late frames keeps its runs when events are added.
    """
    has_late_frames = any(event.kind == STAMP_UNRELIABLE for event in view.payloads(EVENTS))
    has_model = model_of(view) is not None
    return (RIG, POSITIONS, *([MODEL] if has_model else []), *([EVENTS] if has_late_frames else []))


def tracked_part(rig: Rig, _method: str) -> object:
    """Return the part of the rig on which tracks depend: robots, and heights of their markers."""
    return (
        {(m.id, m.robot, m.height_m, m.height_sigma_m) for m in rig.markers},
        rig.marker_height_m,
        rig.marker_height_sigma_m,
    )
