"""Clocks of nodes against the joint calibration of the same log."""

from __future__ import annotations

from collections.abc import Iterator

from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import CLOCKS, MODEL, clock_topic
from ipsys_log.models.table import is_known, reads_corners
from ipsys_log.runs.graph import writes
from ipsys_log.runs.provenance import complete_runs
from ipsys_log.runs.states import is_fitted_here
from ipsys_log.soundness.finding import REMARK, LogFinding

_ADVICE = "write the latency of the camera into latency_ns, or use a network with equal delays both ways"


def check_clocks(session: Session) -> Iterator[LogFinding]:
    """Check the clock estimates of nodes against the newest joint model that was fitted to this log."""
    topics = session.topics(CLOCKS)
    fitted = [run for run in complete_runs(session) if writes(run, MODEL) and is_fitted_here(run)]
    models = [session.payloads(session.topics(MODEL, run.run))[-1] for run in fitted] if topics else []
    joint = [model for model in models if is_known(model.name) and reads_corners(model.name)]
    if not joint:
        return
    # Late: it imports scipy, and most logs have no nodes.
    from ipsys_log.analysis.clock_agreement import find_contradictions

    for one in find_contradictions(joint[-1], session.payloads(topics)):
        yield LogFinding("time", REMARK, one.text, _ADVICE, clock_topic(one.camera))
