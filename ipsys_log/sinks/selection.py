"""What of a session is looked at: which runs, which channels, and the rig that holds for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    EVENTS_TOPIC,
    RIG_TOPIC,
    TRUTH_TOPIC,
    Rig,
    Run,
)
from ipsys_log.messages.channels import EVENTS, MARKERS, POSITIONS, RUN_EVENTS, TRACKS, TRUTH
from ipsys_log.units import NS_PER_S

__all__ = ["Shown", "choose_runs", "fade_ns", "rig_in_force"]

_FADE_STEPS = 3


@dataclass(frozen=True, slots=True)
class Shown:
    """The run with the markers, and those with positions and tracks; then the topics of each kind.

    ``cameras`` are those with frames or markers, ``others`` those that have positions only.
    """

    markers: str | None
    runs: tuple[str, ...]
    frames: tuple[str, ...]
    moving: tuple[str, ...]
    events: tuple[str, ...]
    cameras: tuple[str, ...]
    others: tuple[str, ...]


def choose_runs(session: Session, names: Sequence[str] = ()) -> Shown:
    """What to show: the runs named with the markers they rest on, or the newest ones.

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
    located = [run for run in there if session.topics(TRACKS, run) or session.topics(POSITIONS, run)]
    marked = [run for run in there if session.topics(MARKERS, run)]
    if names:
        sources = _sources(records, names)
        markers = _newest(records, [run for run in marked if run in sources])
        runs = [name for name in dict.fromkeys(names) if name in located]
    else:
        markers, newest = _newest(records, marked), _newest(records, located)
        runs = [newest] if newest else []
    return _topics(session, markers, runs)


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


def _topics(session: Session, markers: str | None, runs: Sequence[str]) -> Shown:
    marked = session.topics(MARKERS, markers) if markers else []
    located = [topic for run in runs for topic in session.topics(POSITIONS, run)]
    tracked = [topic for run in runs for topic in session.topics(TRACKS, run)]
    truth = [TRUTH_TOPIC] if TRUTH_TOPIC in session.topics(TRUTH) else []
    events = [
        topic for run in dict.fromkeys([markers, *runs]) if run for topic in session.topics(RUN_EVENTS, run)
    ]
    recorded = [topic for topic in session.topics(EVENTS) if topic == EVENTS_TOPIC]
    cameras = {*session.images, *(str(camera_of_topic(topic)) for topic in marked)}
    others = {str(camera_of_topic(topic)) for topic in located} - cameras
    return Shown(
        markers,
        tuple(runs),
        (*sorted(session.images.values()), *marked),
        (*located, *tracked, *truth),
        (*recorded, *events),
        tuple(sorted(cameras)),
        tuple(sorted(others)),
    )


def fade_ns(session: Session, topics: Sequence[str], factor: int = 1) -> dict[str, int]:
    """After which silence a topic's last message says nothing of now, from how often it comes."""
    found = {}
    for topic in topics:
        times = [reader.times(topic) for reader in session.readers if topic in reader.channels]
        steps_ns = np.diff(np.unique(np.concatenate(times)).astype(np.int64))
        usual_ns = int(np.median(steps_ns)) if len(steps_ns) else 0
        found[topic] = factor * max(NS_PER_S, _FADE_STEPS * usual_ns)
    return found


def rig_in_force(session: Session, runs: Sequence[str]) -> Rig | None:
    """The rig that the runs to be shown were made with, where it replaced the log's; else the log's last."""
    for record in reversed(session.runs()):
        if record.run in runs and record.rig is not None:
            return record.rig
    rigs = session.payloads([RIG_TOPIC]) if session.count(RIG_TOPIC) else []
    return next((rig for rig in reversed(rigs) if isinstance(rig, Rig)), None)
