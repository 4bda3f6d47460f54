"""Compaction of a log: a copy without superseded and unfinished runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.output import check_copy, create_copy
from ipsys_log.engine.request import Progress
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.log.part import copy_messages, copy_records
from ipsys_log.tools.superseded import SupersededRun, superseded_runs

_STEP = "compact"
_BYTES_PER_STEP = 1_000_000


@dataclass(frozen=True, slots=True)
class DroppedRun:
    """A run that a compaction drops: its messages, and about their bytes in the file, after compression."""

    run: SupersededRun
    messages: int
    stored_bytes: int


def dropped_runs(path: LogLocation) -> list[DroppedRun]:
    """Return the runs that a compaction of a log drops, by name; only their chunks are read.

    Raises
    ------
    LogError
        The log is damaged.
    """
    with Session([path]) as session:
        runs = superseded_runs(session)
        (reader,) = session.readers
        names = {run.run for run in runs}
        sizes = reader.sizes(topics={topic for topic in reader.channels if run_of_topic(topic) in names})
    rows = {
        name: [size for size in sizes if run_of_topic(size.topic) == name]
        for name in (run.run for run in runs)
    }
    return [
        DroppedRun(
            run,
            sum(size.messages for size in rows[run.run]),
            sum(size.stored_bytes for size in rows[run.run]),
        )
        for run in runs
    ]


@one_reading()
def compact(
    path: LogLocation,
    output: Path,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> None:
    """Write a copy of a log without its superseded runs; all other messages stay the same.

    The copy gets its name when it is complete. Each kept channel has the same messages, so the records of the
    kept runs are true for the copy, too.

    Parameters
    ----------
    overwrite : replace an existing log.

    Raises
    ------
    IpsysError
        The output exists, or is the log itself.
    LogError
        The log is damaged.
    """
    check_copy([path], output, overwrite)
    with Session([path]) as session:
        dropped = {run.run for run in superseded_runs(session)}
        (reader,) = session.readers

        def choose(topic: str, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
            return np.full(len(times_ns), run_of_topic(topic) not in dropped)

        total = reader.size // _BYTES_PER_STEP
        with create_copy(output, overwrite) as writer:
            copy_messages(
                reader, writer, choose, lambda done: progress(_STEP, done // _BYTES_PER_STEP, total)
            )
            copy_records(reader, writer)
