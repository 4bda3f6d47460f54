"""Provenance of runs: their names, inputs, fingerprints, and the versions of their stages.

A version rises by one with each change of the output for the same input. The parameters of a run name its
versions, except version 1. Versions of packages make no run out of date: they are in its fingerprint.
"""

from __future__ import annotations

import platform
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version

import threadpoolctl

from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, CameraCalibration, ChannelRead, Run
from ipsys_log.messages.channels import MARKERS, Channel
from ipsys_log.runs.origins import has_result, present_inputs, was_complete

# The parameter ``format`` of the record of markers that nodes have sent.
NODE_FORMAT = "node"
_MOST_DIGITS = 6


def recorded_version(run: Run, name: str) -> int:
    """Return the version of a stage, method or model that made a run."""
    text = run.parameters.get(name, "1")
    return int(text) if text.isascii() and text.isdigit() and len(text) <= _MOST_DIGITS else 1


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a stage: its run, whether it was made now, and remarks."""

    stage: str
    run: str
    fresh: bool
    messages: int = 0
    remarks: tuple[str, ...] = ()


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    packages = ("ipsys_log", "numpy", "scipy", "scikit-learn", "opencv-python-headless", "simplejpeg")
    return (("python", platform.python_version()), *((name, version(name)) for name in packages))


def fingerprint() -> dict[str, str]:
    """Return the environment on which the digits of a result can depend: versions and BLAS kernel."""
    import scipy.linalg  # noqa: F401 - its BLAS must be loaded to be named

    kernels = {
        f"{library.get('internal_api')} {library.get('version')} {library.get('architecture', '')}".strip()
        for library in threadpoolctl.threadpool_info()
        if library.get("user_api") == "blas"
    }
    return {**dict(_versions()), "machine": platform.machine(), "blas": ", ".join(sorted(kernels))}


def read_channels(session: Session, topics: Iterable[str]) -> tuple[ChannelRead, ...]:
    """Return the input of a stage by topic, identified by its content (law 4 of the log)."""
    return tuple(ChannelRead(topic, session.count(topic), session.hash(topic)) for topic in sorted(topics))


def _identity(run: Run) -> bytes:
    """Return the identity of a run of a stage: all fields except names, times and the environment."""
    return encode(replace(run, timestamp=0, run="", fingerprint={}, input_runs=(), outputs=(), number=0))


def replaced_lenses(run: Run) -> dict[str, CameraCalibration]:
    """Return the intrinsics that replaced those of the log in a run."""
    return {
        lens.camera: CameraCalibration(
            0, lens.camera, lens.width, lens.height, lens.distortion_model, lens.d, lens.k
        )
        for lens in run.lenses
    }


def complete_runs(session: Session) -> list[Run]:
    """Return the records whose channels are all in the log, oldest first."""
    return [run for run in session.runs() if is_complete(session, run)]


def is_complete(session: Session, run: Run) -> bool:
    """Return whether all channels of a stage are in the log, or were before the log was cut."""
    return all(
        session.count(output.topic) >= output.messages or was_complete(session, output.topic, output.messages)
        for output in run.outputs
    )


def find_run(session: Session, wanted: Run, purpose: Channel, name: str | None = None) -> str | None:
    """Return the name of the newest complete run with the inputs and parameters of ``wanted``, if any.

    In a part of a log, a run is found if its inputs were cut and did not change otherwise.

    Parameters
    ----------
    purpose : the channel of the result, which a part must have.
    """
    essence = _identity(wanted)
    for run in reversed(complete_runs(session)):
        if run.stage == wanted.stage and name in (None, run.run):
            here = replace(run, inputs=present_inputs(session, run)) if session.cuts else run
            if _identity(here) == essence and has_result(session, run, purpose):
                return run.run
    return None


def with_inputs(names: Iterable[str], reads: Mapping[str, Collection[str]]) -> set[str]:
    """Return runs and all runs that they have read, directly or through others.

    Parameters
    ----------
    reads : by run, the runs that its stages have read.

    Examples
    --------
    >>> sorted(with_inputs(["poly"], {"poly": ["edges"], "edges": ["edges"], "rigid": ["stock"]}))
    ['edges', 'poly']
    """
    waiting, reached = list(names), set(names)
    while waiting:
        new = set(reads.get(waiting.pop(), ())) - reached
        reached |= new
        waiting += new
    return reached


def free_name(session: Session, record: Run, base: str, writes: Sequence[Channel]) -> str:
    """Return the name for a new run: ``base``, or ``base_2``, ``base_3`` ... if ``base`` is taken.

    A stage joins the run that it reads from, if that run does not have the stage yet. Any other name must
    be new: a run holds only results that belong together.
    """
    taken = session.run_names()
    joins = base in record.input_runs and not _has_stage(session, record.stage, base, writes)
    if joins or base not in taken:
        return base
    number = 2
    while f"{base}_{number}" in taken:
        number += 1
    return f"{base}_{number}"


def _has_stage(session: Session, stage: str, name: str, writes: Sequence[Channel]) -> bool:
    """Return whether a run has a stage, by its record or by the first channel that the stage writes."""
    recorded = any((run.run, run.stage) == (name, stage) for run in session.runs())
    return recorded or bool(session.topics(writes[0], name))


def check_run_name(session: Session, stage: str, name: str, writes: Sequence[Channel]) -> str:
    """Return the name that a user gave a run, if the run does not have that stage yet.

    Raises
    ------
    IpsysError
        The run already has that stage.
    """
    if _has_stage(session, stage, name, writes):
        raise IpsysError(f"run {name} already has the stage {stage} with other input; use another --run name")
    return name


def newest_run(session: Session, channel: Channel) -> str | None:
    """Return the run whose newest complete stage wrote a channel.

    Imported channels belong to no recorded stage: they count with any complete stage of their run.
    """
    recorded = {output.topic for run in session.runs() for output in run.outputs}
    for run in reversed(complete_runs(session)):
        topics = set(session.topics(channel, run.run))
        if topics and (topics.isdisjoint(recorded) or topics & {output.topic for output in run.outputs}):
            return run.run
    return None


def imported_inputs(session: Session) -> dict[Channel, str]:
    """Return the run of the markers that nodes have sent instead of images, for a stage that passes them on.

    Cameras with images have none in this run: a stage detects their markers. In a log without images, the
    next stages read the run itself.
    """
    for run in reversed(session.runs()) if session.images else ():
        if run.stage == IMPORTED and run.parameters.get("format") == NODE_FORMAT:
            cameras = {camera_of_topic(topic) for topic in session.topics(MARKERS, run.run)}
            if cameras and cameras.isdisjoint(session.images):
                return {MARKERS: run.run}
    return {}
