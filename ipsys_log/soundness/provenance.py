"""Provenance of the runs of a log: complete, with their inputs, and current."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import IMPORTED
from ipsys_log.messages.channels import IMAGES, MODEL, RECORD
from ipsys_log.runs.graph import writes
from ipsys_log.runs.states import Recorded, is_fitted_here, recorded_stages
from ipsys_log.soundness.finding import NOTE, REMARK, LogFinding

# Logs without images are smaller: their markers are the start of all later stages.
_IMAGE = IMAGES.topic.rpartition("/")[2]


def find_input_logs(session: Session, others: Sequence[LogLocation]) -> list[LogLocation]:
    """Return the logs among ``others`` with inputs of runs that the log of ``session`` lacks in part."""
    needed = {
        read.topic: read.hash
        for run in session.runs()
        for read in run.inputs
        if read.messages != session.count(read.topic)
    }
    return [path for path in others if needed and _has_input(path, needed)]


def _has_input(path: LogLocation, needed: dict[str, str]) -> bool:
    with suppress(IpsysError), Session([path]) as other:
        # An input from several logs has the hash of each of them, joined by "+".
        return any(
            other.count(topic) and other.hash(topic) in wanted.split("+") for topic, wanted in needed.items()
        )
    return False


def check_runs(session: Session, names: Collection[str]) -> Iterator[LogFinding]:
    """Check the runs with these names: their records, their inputs and their states."""
    recorded = recorded_stages(session)
    for stage in recorded:
        if stage.run.run in names:
            yield _check_stage(session, stage)
    for name in sorted(set(names) - {stage.run.run for stage in recorded}):
        text = f"run {name} has no record: its writer was stopped"
        yield LogFinding("run", REMARK, text, "ipsys replay computes it again", RECORD.topic_of(name))


def _check_stage(session: Session, stage: Recorded) -> LogFinding:
    run = stage.run
    text = f"run {run.run}, {run.stage}: {stage.state}"
    topic = RECORD.topic_of(run.run)
    missing = [read.topic for read in run.inputs if read.messages and not session.count(read.topic)]
    is_copy = run.stage == IMPORTED or (writes(run, MODEL) and not is_fitted_here(run))
    if stage.is_newer:
        return LogFinding("run", REMARK, text, "", topic)
    if stage.state == "unfinished" or stage.out_of_date:
        return LogFinding("run", REMARK, text, "ipsys replay computes it again", topic)
    if any(not topic.endswith(f"/{_IMAGE}") for topic in missing) and not (is_copy or stage.is_part):
        text = f"run {run.run}, {run.stage}: its input {missing[0]} is not in the log"
        return LogFinding("run", REMARK, text, "give the log with this input too", topic)
    return LogFinding("run", NOTE, text, "", topic)
