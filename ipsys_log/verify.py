"""The proof that a log replays: every run made again from what it read, and compared byte for byte."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from ipsys_log.compare import Comparison, compare_channels
from ipsys_log.errors import IpsysError
from ipsys_log.log.session import Session, run_of_topic
from ipsys_log.messages import CameraCalibration, CameraPoints, Markers, Message, Model, Positions, Run
from ipsys_log.pipeline import carry_out
from ipsys_log.runs.request import Progress, Request
from ipsys_log.runs.tasks import Task, plan_stage
from ipsys_log.stages.camera_frame import PERIMETER

__all__ = ["diff", "verify"]

# What a model's run has among its parameters if the model was fitted to places of the same log.
_FITTED_HERE = {"train", "seed"}


def verify(paths: Sequence[Path], run: str | None, progress: Progress) -> list[Comparison]:
    """Make every run again, from its recorded input, and compare.

    A model that was copied in cannot be made again, nor can what was evaluated of it; what was made with it
    can.

    Parameters
    ----------
    run : only this one; None: all.

    Returns
    -------
    One comparison for each derived channel; the log is on the left.

    Raises
    ------
    IpsysError
        Where there is no such run, or it was made from something that the log no longer holds.
    """
    with Session(paths) as session, threadpool_limits(1, user_api="blas"):
        names = session.run_names() if run is None else session.run_names() & {run}
        records = [one for one in session.runs() if one.run in names]
        if not any(_from_this_log(one) for one in records):
            raise IpsysError(
                f"{session}: has no {'run' if run is None else f'run {run}'} to verify; "
                "make one with 'ipsys replay', or see 'ipsys runs'"
            )
        found = []
        for name in sorted(names):
            stages = [one for one in records if one.run == name and _from_this_log(one)]
            topics = {output.topic for one in stages for output in one.outputs}
            # Stages can share a channel, that of events.
            made = heapq.merge(
                *(_made_again(session, one, progress) for one in stages), key=lambda one: one.log_time_ns
            )
            found += compare_channels(session.messages(sorted(topics)), made)
        return sorted([*found, *_unrecorded(session, names)], key=lambda one: one.topic)


def _from_this_log(run: Run) -> bool:
    return run.stage not in ("fit", "evaluate") or bool(run.parameters.keys() & _FITTED_HERE)


def _unrecorded(session: Session, names: Collection[str]) -> list[Comparison]:
    """Channels of runs that no record says anything of."""
    known = {output.topic for one in session.runs() for output in one.outputs}
    return [
        Comparison(topic, session.count(topic), 0, 0, 0, "no record says how it was made", 0)
        for topic in sorted({topic for reader in session.readers for topic in reader.channels} - known)
        if run_of_topic(topic) in names and not topic.endswith("/record") and session.count(topic)
    ]


def diff(left: Path, right: Path, runs: tuple[str | None, str | None]) -> list[Comparison]:
    """Compare the derived channels of two logs, or of two runs.

    Parameters
    ----------
    runs : of the left and of the right log; None: all that both have.

    Raises
    ------
    IpsysError
        Where a run is not there, or there is nothing that both have.
    """
    with Session([left]) as one, Session([right]) as other:
        names = [_run_names(one, runs[0]), _run_names(other, runs[1])]
        both = names[0] & names[1] if runs[0] is None else names[0]
        if not both:
            raise IpsysError(
                f"{left} and {right} have no run of one name (see 'ipsys runs'); say which with --run"
            )
        ours = _derived(one, both, None)
        theirs = _derived(other, both if runs[1] is None else names[1], runs[0])
        return compare_channels(ours, theirs)


def _run_names(session: Session, wanted: str | None) -> set[str]:
    names = session.run_names()
    if wanted is not None and wanted not in names:
        raise IpsysError(f"{session}: has no run {wanted}; it has {', '.join(sorted(names)) or 'none'}")
    return names if wanted is None else {wanted}


def _derived(session: Session, runs: set[str], called: str | None) -> Iterator[Message]:
    """What runs have written, but for their records; as that of a run ``called`` otherwise."""
    topics = {
        topic
        for reader in session.readers
        for topic in reader.channels
        if run_of_topic(topic) in runs and not topic.endswith("/record")
    }
    for message in session.messages(topics):
        name = run_of_topic(message.topic)
        topic = (
            message.topic if called is None else message.topic.replace(f"/runs/{name}/", f"/runs/{called}/")
        )
        yield Message(topic, message.log_time_ns, message.publish_time_ns, message.payload, message.camera)


def _made_again(session: Session, run: Run, progress: Progress) -> Iterator[Message]:
    for read in run.inputs:
        if session.count(read.topic) != read.messages or session.hash(read.topic) != read.hash:
            raise IpsysError(
                f"{session}: run {run.run} was made from {read.messages} messages of {read.topic}, and these "
                f"are not what the log holds now ({session.count(read.topic)} messages): it is out of date, "
                "or the log it was made from has to be given too"
            )
    task = plan_stage(run.stage, session, _request(run), **_given(session, run))
    if isinstance(task, Task):
        yield from carry_out(task, session, run.run, progress)


def _request(run: Run) -> Request:
    lenses = {
        one.camera: CameraCalibration(
            0, one.camera, one.width, one.height, one.distortion_model, one.d, one.k
        )
        for one in run.lenses
    }
    return Request(
        rig=run.rig,
        lenses=lenses,
        corners=run.parameters.get("corners"),
        method=run.parameters.get("method", PERIMETER),
        train=run.parameters.get("train", "train"),
        seed=int(run.parameters.get("seed", "0")),
        as_live="as_live" in run.parameters,
    )


def _given(session: Session, run: Run) -> dict[str, str]:
    """The runs that it has read from, as the plan wants them."""
    read = {read.topic for read in run.inputs}

    def source(payload: type) -> str:
        names = {name for name in session.run_names() if read & set(session.topics(payload, name))}
        return names.pop() if names else ""

    return {
        "detect": {},
        "camera-frame": {"markers": source(Markers)},
        "fit": {"points": source(CameraPoints), "model": run.parameters.get("model", "")},
        "evaluate": {"points": source(CameraPoints), "model": source(Model)},
        "locate": {"points": source(CameraPoints), "model": source(Model)},
        "fuse": {"positions": source(Positions)},
    }[run.stage]
