"""Selection of the content to show: runs, channels, and the rig that these runs used."""

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
    Model,
    Rig,
    Run,
)
from ipsys_log.messages.channels import EVENTS, MARKERS, MODEL, POSITIONS, RUN_EVENTS, TRACKS, TRUTH
from ipsys_log.units import NS_PER_S

_FADE_STEPS = 3


@dataclass(frozen=True, slots=True)
class Shown:
    """The content to show: the run of the markers, the runs of positions and tracks, and the topics by kind.

    ``cameras`` are the cameras with frames or markers, ``others`` the cameras with positions only.
    """

    markers: str | None
    runs: tuple[str, ...]
    frames: tuple[str, ...]
    moving: tuple[str, ...]
    events: tuple[str, ...]
    cameras: tuple[str, ...]
    others: tuple[str, ...]


def choose_runs(session: Session, names: Sequence[str] = ()) -> Shown:
    """Choose the runs to show: the named runs with the markers that they use, or the newest runs.

    Raises
    ------
    IpsysError
        No complete run has one of the names.
    """
    records = session.runs()
    known = list(dict.fromkeys(record.run for record in records))
    for name in names:
        if name not in known:
            raise IpsysError(f"{session}: has no run {name!r}; it has {', '.join(known) or 'none'}")
    located = [run for run in known if session.topics(TRACKS, run) or session.topics(POSITIONS, run)]
    marked = [run for run in known if session.topics(MARKERS, run)]
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
    """Return some runs, and all runs from which they were made."""
    sources: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name not in sources:
            sources.add(name)
            waiting += [source for record in records if record.run == name for source in record.input_runs]
    return sources


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
    """Return by topic the silence in ns after which its last message is obsolete, from its usual period."""
    fades_ns = {}
    for topic in topics:
        times = [reader.times(topic) for reader in session.readers if topic in reader.channels]
        steps_ns = np.diff(np.unique(np.concatenate(times)).astype(np.int64))
        usual_ns = int(np.median(steps_ns)) if len(steps_ns) else 0
        fades_ns[topic] = factor * max(NS_PER_S, _FADE_STEPS * usual_ns)
    return fades_ns


def rig_in_force(session: Session, runs: Sequence[str]) -> Rig | None:
    """Return the rig that replaced the log's rig in the shown runs; else the last rig of the log."""
    for record in reversed(session.runs()):
        if record.run in runs and record.rig is not None:
            return record.rig
    rigs = session.payloads([RIG_TOPIC]) if session.count(RIG_TOPIC) else []
    return next((rig for rig in reversed(rigs) if isinstance(rig, Rig)), None)


def model_in_force(session: Session, run: str) -> Model | None:
    """Return the fitted model of a run, or of a run from which it was made; None if the log has none."""
    records = session.runs()
    fitted = [name for name in _sources(records, [run]) if session.topics(MODEL, name)]
    newest = run if run in fitted else _newest(records, fitted)
    models = [] if newest is None else session.payloads(session.topics(MODEL, newest))
    return models[-1] if models else None
