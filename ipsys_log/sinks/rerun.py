"""A session in Rerun: frames with their markers, the floor, positions and tracks over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import rerun as rr

from ipsys_log.errors import IpsysError
from ipsys_log.log.session import Session, camera_of_topic
from ipsys_log.messages import (
    EVENTS_TOPIC,
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    TRUTH_TOPIC,
    Event,
    Markers,
    Positions,
    Rig,
    Run,
    Tracks,
)
from ipsys_log.sinks.places import Place, measured_places
from ipsys_log.sinks.rerun_scene import draw_places, draw_rig, layout
from ipsys_log.sinks.rerun_sink import RerunSink, trail_entity
from ipsys_log.sinks.rerun_viewer import check_screen, show_in_viewer
from ipsys_log.units import NS_PER_S

__all__ = ["Shown", "choose_runs", "write_recording"]

_FADE_STEPS = 3
_LEAST_FADE_NS = NS_PER_S
# Messages between two looks at what the viewer can have; enough to keep a pipe busy.
_BATCH = 64


@dataclass(frozen=True, slots=True)
class Shown:
    """What of a session is shown: the run with the markers, and those with positions and tracks."""

    markers: str | None
    runs: tuple[str, ...]

    def __str__(self) -> str:
        named = [f"markers of run {self.markers}"] if self.markers else []
        named += [f"positions and tracks of run {run}" for run in self.runs]
        return ", ".join(named) or "no run"


def choose_runs(session: Session, names: Sequence[str] = ()) -> Shown:
    """Which runs to show: those named with the markers they rest on, or the newest ones.

    Raises
    ------
    IpsysError
        For a name that no complete run has.
    """
    records = session.runs()
    there = list(dict.fromkeys(record.run for record in records))
    for name in names:
        if name not in there:
            raise IpsysError(f"{session}: there is no run {name!r} (there are: {', '.join(there) or 'none'})")
    located = [run for run in there if session.topics(Tracks, run) or session.topics(Positions, run)]
    marked = [run for run in there if session.topics(Markers, run)]
    if not names:
        return Shown(_newest(records, marked), tuple(filter(None, [_newest(records, located)])))
    sources = _sources(records, names)
    markers = _newest(records, [run for run in marked if run in sources])
    return Shown(markers, tuple(name for name in dict.fromkeys(names) if name in located))


def _newest(records: Sequence[Run], among: Sequence[str]) -> str | None:
    return next((record.run for record in reversed(records) if record.run in among), None)


def _sources(records: Sequence[Run], names: Sequence[str]) -> set[str]:
    """Some runs, and all that they were made from."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += [source for record in records if record.run == name for source in record.input_runs]
    return found


def write_recording(
    session: Session, runs: Sequence[str] = (), save: Path | None = None, events: bool = True
) -> Shown:
    """Show a session in the Rerun viewer until its window is closed, or save it for the viewer.

    Parameters
    ----------
    session : open logs.
    runs : names of the runs to show; the newest complete ones where empty.
    save : an ``.rrd`` file to write, instead of opening a window; it is there only when complete.
    events : whether to list events too.

    Returns
    -------
    What is shown.

    Raises
    ------
    IpsysError
        For logs with nothing to show, an unknown run, or, without ``save``, no screen.
    """
    shown = choose_runs(session, runs)
    session_view = _View(session, shown, events)
    session_view.check()
    if save is None:
        show_in_viewer(session_view.feed)
        return shown
    partial = save.with_name(save.name + ".partial")
    partial.touch()  # what is wrong with the name is said here, not by Rerun
    try:
        session_view.write(partial)
        partial.replace(save)
    finally:
        partial.unlink(missing_ok=True)
    return shown
