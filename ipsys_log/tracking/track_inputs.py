"""Inputs of the stages that track robots: channels, the part of the rig, errors of the calibration."""

from __future__ import annotations

from ipsys_log.messages import STAMP_UNRELIABLE, Model, Rig
from ipsys_log.messages.channels import EVENTS, MODEL, POSITIONS, RIG, Channel
from ipsys_log.messages.stage import StageView
from ipsys_log.tracking.bias_modes import BiasModes

__all__ = ["TRACK_READS", "make_modes", "model_of", "track_reads", "tracked_part"]

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


def make_modes(model: Model | None, rig: Rig) -> BiasModes:
    """Return the errors of the calibration of a model; none without a model."""
    if model is None:
        return BiasModes.none()
    # Late: the modes of a joint model need scipy.
    from ipsys_log.tracking.calibration_modes import calibration_modes

    return calibration_modes(model, rig)


def tracked_part(rig: Rig, _method: str) -> object:
    """Return the part of the rig on which tracks depend: robots, and sizes and heights of their markers."""
    return (
        {(m.id, m.robot, m.height_m, m.height_sigma_m) for m in rig.markers},
        rig.marker_height_m,
        rig.marker_height_sigma_m,
        rig.marker_length_m,
    )
