"""Stages for tests, wired by hand."""

from collections.abc import Mapping

from ipsys_log.engine.stream import WiredStage, wire
from ipsys_log.messages.channels import Channel
from ipsys_log.messages.stage import Plan, Stage, StageView, Step


def wired(
    run: str,
    reads: tuple[Channel, ...],
    writes: tuple[Channel, ...],
    step: Step,
    inputs: Mapping[Channel, str] | None = None,
    per_camera: bool = True,
) -> WiredStage:
    """Wire a step to channels; ``inputs`` are the runs of the derived ones."""

    def plan(view: StageView, options: Mapping[str, str]) -> Plan:
        raise AssertionError("a stage that is wired by hand is not planned")

    stage = Stage(
        name="test",
        versions={},
        reads=reads,
        writes=writes,
        plan=plan,
        rig_part=lambda rig, method: rig,
        per_camera=per_camera,
    )
    return wire(stage, run, inputs or {}, step)
