"""The bookkeeping of runs: which exist, which are still right, what the next one is called."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

import threadpoolctl

from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log import LogWriter
from ipsys_log.log.codec import encode, schema_data, schema_name
from ipsys_log.log.session import Session
from ipsys_log.log.types import Schema
from ipsys_log.messages import ChannelRead, ChannelWritten, Message, Run

__all__ = [
    "Outcome",
    "find_run",
    "fingerprint",
    "free_name",
    "newest_run",
    "read_channels",
    "write_log",
    "write_messages",
]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one stage: the run that holds it, whether it was made just now, what to know of it."""

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
    """The environment that the digits of a result can depend on: versions and BLAS kernel."""
    kernels = {
        f"{library.get('internal_api')} {library.get('version')} {library.get('architecture', '')}".strip()
        for library in threadpoolctl.threadpool_info()
        if library.get("user_api") == "blas"
    }
    return {**dict(_versions()), "machine": platform.machine(), "blas": ", ".join(sorted(kernels))}


def read_channels(session: Session, topics: Iterable[str]) -> tuple[ChannelRead, ...]:
    """What a stage reads, known again by its content (law 4 of the log)."""
    return tuple(ChannelRead(topic, session.count(topic), session.hash(topic)) for topic in sorted(topics))


def _essence(run: Run) -> bytes:
    """What makes two runs of a stage the same: everything but names, times and the environment."""
    return encode(replace(run, timestamp=0, run="", fingerprint={}, input_runs=(), outputs=(), number=0))


def find_run(runs: Sequence[Run], wanted: Run, name: str | None = None) -> str | None:
    """Name of the newest run that has done just what ``wanted`` would do, if there is one."""
    essence = _essence(wanted)
    for run in reversed(runs):
        if run.stage == wanted.stage and name in (None, run.run) and _essence(run) == essence:
            return run.run
    return None


def free_name(runs: Sequence[Run], stage: str, base: str) -> str:
    """``base``, or ``base_2``, ``base_3`` ... where that run already has this stage."""
    taken = {run.run for run in runs if run.stage == stage}
    name, number = base, 1
    while name in taken:
        number += 1
        name = f"{base}_{number}"
    return name


def newest_run(session: Session, payload: type) -> str | None:
    """The run that wrote a type of payload last, among the complete ones."""
    for run in reversed(session.runs()):
        if session.topics(payload, run.run):
            return run.run
    return None


def write_messages(writer: LogWriter, messages: Iterable[Message]) -> dict[str, int]:
    """Put messages into an open log; returns how many went to each topic."""
    counts: dict[str, int] = {}
    for message in messages:
        name = schema_name(type(message.payload))
        if message.topic not in counts:
            writer.add_channel(message.topic, Schema(name, "protobuf", schema_data(name)))
        writer.write(message.topic, message.log_time_ns, message.publish_time_ns, encode(message.payload))
        counts[message.topic] = counts.get(message.topic, 0) + 1
    return counts


def write_log(path: Path, messages: Iterable[Message]) -> dict[str, int]:
    """Write a new log; after an error nothing of it is left.

    Returns
    -------
    How many messages went to each topic.
    """
    with LogWriter.create(path, atomic=True) as writer:
        return write_messages(writer, messages)


def append_run(path: Path, record: Run, log_time_ns: int, messages: Callable[[], Iterable[Message]]) -> Run:
    """Append what a stage makes, then its record, in one step: all of it is in the log, or nothing.

    Raises
    ------
    LogError
        Where another process has written this stage of this run meanwhile.
    """
    with LogWriter.append(path) as writer:
        with Session([path]) as now:
            if any((run.run, run.stage) == (record.run, record.stage) for run in now.runs()):
                raise LogError(f"{path}: another process has just written run {record.run}; start again")
        counts = write_messages(writer, messages())
        outputs = tuple(ChannelWritten(topic, count) for topic, count in sorted(counts.items()))
        done = replace(record, outputs=outputs)
        topic = f"/runs/{record.run}/record"
        write_messages(writer, [Message(topic, log_time_ns, record.timestamp, done)])
    return done


def check_run_name(runs: Sequence[Run], stage: str, name: str) -> str:
    """Return the name that a user gave a run, if the run does not have that stage yet.

    Raises
    ------
    IpsysError
        Otherwise.
    """
    if any(run.run == name and run.stage == stage for run in runs):
        raise IpsysError(f"run {name} already has the stage {stage} from other input; use another --run name")
    return name
