"""The state of recorded runs: would this software compute the same?"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

from ipsys_log.engine.graph import VERSIONS, method_of, versioned_names, writes
from ipsys_log.engine.provenance import (
    complete_runs,
    copied_from,
    is_complete,
    is_whole,
    original_of,
    recorded_version,
)
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, MEASUREMENTS_TOPIC, RIG_TOPIC, ChannelRead, Run
from ipsys_log.messages.channels import EVALUATION, MODEL
from ipsys_log.models.table import CORNER_MODELS, MODELS

CURRENT = "current"
# The record of a model that was fitted to measurements of the same log has one of these parameters.
_FITTED_HERE = frozenset(("train", "seed"))


@dataclass(frozen=True, slots=True)
class Recorded:
    """A stage of a run and its state.

    Attributes
    ----------
    run : the record of the stage.
    method : its corner method, camera-point method or model; "" if the stage has none.
    state : ``current``, ``out of date: <reason>``, ``not repeatable``, ``unfinished``,
        ``copied from <log>``, or what to do if newer software made it.
    out_of_date : the software, the log or an input run has changed since, and the stage can be repeated.
    is_newer : newer software made it.
    is_copied : it was copied from another log, and this one has only a part of its channels, or other times.
    """

    run: Run
    method: str
    state: str = CURRENT
    out_of_date: bool = False
    is_newer: bool = False
    is_copied: bool = False

    @property
    def is_of_other_version(self) -> bool:
        """Return whether older or newer software made the stage, perhaps with another result."""
        names = versioned_names(self.run.stage, self.method)
        return any(recorded_version(self.run, name) != VERSIONS.get(name) for name in names)

    @property
    def stage_version(self) -> int:
        """The version of the stage at the time of the run."""
        return recorded_version(self.run, self.run.stage)


def recorded_stages(session: Session) -> list[Recorded]:
    """Return every recorded stage with its state, oldest first."""
    stages = [_judge(session, Recorded(run, method_of(session, run))) for run in session.runs()]
    stale: set[str] = set()  # topics of the stages that are out of date
    while True:
        more = {output.topic for stage in stages if stage.out_of_date for output in stage.run.outputs} - stale
        if not more:
            return stages
        stale |= more
        stages = [_judge_inputs(stage, stale) for stage in stages]


def newest_evaluations(session: Session) -> list[Recorded]:
    """Return the newest complete evaluation of each model, in the order of the table of models."""
    complete = {run.run for run in complete_runs(session) if writes(run, EVALUATION)}
    stages = [one for one in recorded_stages(session) if writes(one.run, EVALUATION)]
    newest = {one.method: one for one in stages if one.run.run in complete}
    return [newest[name] for name in (*MODELS, *CORNER_MODELS) if name in newest]


def out_of_date_lines(session: Session, names: Iterable[str | None]) -> list[str]:
    """Return a line for each run of these names that is out of date, with its first such stage."""
    lines: dict[str, str] = {}
    wanted = set(names)
    for recorded in recorded_stages(session):
        is_shown = recorded.run.run in wanted and not writes(recorded.run, EVALUATION)
        if is_shown and (recorded.out_of_date or recorded.is_newer):
            advice = "" if recorded.is_newer else "; ipsys replay computes it again"
            lines.setdefault(
                recorded.run.run, f"run {recorded.run.run}: {recorded.run.stage} is {recorded.state}{advice}"
            )
    return list(lines.values())


def made_by_newer(session: Session, run: Run) -> str:
    """Return the state of a stage that newer software made; "" for any other. Channels are not read."""
    for name in versioned_names(run.stage, method_of(session, run)):
        version = recorded_version(run, name)
        if version > VERSIONS.get(name, 0):
            present = f"this is {name} {VERSIONS[name]}" if name in VERSIONS else "which is not known here"
            return f"made by {name} {version}, {present}: update ipsys"
    return ""


def is_fitted_here(run: Run) -> bool:
    """Return whether a model was fitted, or evaluated, with measurements of the same log."""
    return bool(run.parameters.keys() & _FITTED_HERE)


def _judge(session: Session, one: Recorded) -> Recorded:
    """Return a stage with its state, derived from its own record and the log."""
    run = one.run
    if not is_complete(session, run):
        return replace(one, state="unfinished")
    if run.stage == IMPORTED:
        return replace(one, state="not repeatable")
    if newer := made_by_newer(session, run):
        return replace(one, state=newer, is_newer=True)
    names = versioned_names(run.stage, one.method)
    is_of_copied_model = writes(run, MODEL) and not is_fitted_here(run)
    logs = () if is_of_copied_model else copied_from(session, run)
    missing = any(read.messages and not session.count(read.topic) for read in run.inputs) and not logs
    if is_of_copied_model or missing:
        return replace(one, state="not repeatable")
    reasons = [
        f"made by {name} {recorded_version(run, name)}, this is {name} {VERSIONS[name]}"
        for name in names
        if recorded_version(run, name) < VERSIONS[name]
    ]
    if logs and not reasons:
        return replace(one, state=f"copied from {', '.join(logs)}", is_copied=True)
    changed = (read for read in run.inputs if not is_whole(session, read))
    reasons += [_change(read) for read in changed if original_of(session, read) is None]
    return replace(one, state=f"out of date: {reasons[0]}", out_of_date=True) if reasons else one


def _judge_inputs(one: Recorded, stale: Collection[str]) -> Recorded:
    """Return a stage; mark a current stage as out of date if it read a ``stale`` topic."""
    names = [str(run_of_topic(read.topic)) for read in one.run.inputs if read.topic in stale]
    if one.state != CURRENT or not names:
        return one
    return replace(one, state=f"out of date: input {names[0]} is", out_of_date=True)


def _change(read: ChannelRead) -> str:
    camera = camera_of_topic(read.topic)
    if read.topic == MEASUREMENTS_TOPIC:
        return "measurements changed"
    if read.topic == RIG_TOPIC:
        return "the rig changed"
    return f"the lens of {camera} changed" if read.topic.endswith("/calibration") else f"{read.topic} changed"
