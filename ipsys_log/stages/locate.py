"""The stage *locate*: camera points or corners to world positions, with the model of each camera."""

from collections.abc import Mapping

from ipsys_log.messages import Model
from ipsys_log.messages.channels import (
    CAMERA_POINTS,
    CAMERA_POSES,
    MARKERS,
    MODEL,
    POSITIONS,
    RIG,
    RUN_EVENTS,
)
from ipsys_log.messages.stage import Plan, Stage, StageView, model_read
from ipsys_log.statistics.model_kinds import model_kind


def _plan(view: StageView, _options: Mapping[str, str]) -> Plan:
    model: Model = view.payloads(MODEL)[-1]
    kind = model_kind(model.name)
    watched = (CAMERA_POSES,) if view.run(CAMERA_POSES) else ()
    return Plan(
        run=view.run(CAMERA_POSES) or view.run(MODEL),
        parameters={},
        reads=(*kind.reads(model.name), MODEL, *watched),
        step=lambda run: kind.step(model),
    )


STAGE = Stage(
    name="locate",
    versions={"locate": 4},
    reads=(RIG, MARKERS, CAMERA_POINTS, MODEL, CAMERA_POSES),
    writes=(POSITIONS, RUN_EVENTS),
    plan=_plan,
    rig_part=lambda rig, model: model_kind(model).place_part(rig),
    method=model_read,
    # An event names a marker once, of whichever cameras.
    per_camera=False,
)
