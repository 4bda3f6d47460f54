"""Conditions for logs that are read together: separate runs, separate images, unique ids of measurements."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

from ipsys_log.errors import LogError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.location import LogLocation
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import Measurement, Run


def check_overlaps(readers: Sequence[LogReader], image_topics: Collection[str]) -> None:
    """Refuse logs that have images of the same camera, or results of the same run, at the same time.

    Sessions one after the other may have runs of the same name: such a run is read as one.

    Raises
    ------
    LogError
        The text names the topic and both logs.
    """
    first: dict[str, LogReader] = {}
    for reader in readers:
        for topic in reader.channels:
            other = first.setdefault(topic, reader)
            if other is reader or topic.endswith("/record"):
                continue
            if topic in image_topics and _overlap(reader, other, topic):
                raise LogError(
                    f"two cameras have the same name: {topic} is in {other.path} and, at the same time, "
                    f"in {reader.path}; leave one of them out"
                )
            if run_of_topic(topic) is not None and _overlap(reader, other, topic):
                raise LogError(
                    f"{topic} is in {other.path} and, at the same time, in {reader.path}; leave one of "
                    "them out"
                )


def _overlap(one: LogReader, other: LogReader, topic: str) -> bool:
    first, second = one.first_time(topic), other.first_time(topic)
    if first is None or second is None:
        return False
    return first <= (other.last_time(topic) or 0) and second <= (one.last_time(topic) or 0)


def check_same_parameters(logs: Iterable[tuple[LogLocation, Iterable[Run]]]) -> None:
    """Refuse logs in which a stage made a run of the same name in different ways.

    Parameters
    ----------
    logs : the path of each log, and the records of its runs.

    Raises
    ------
    LogError
        The text names the run and both logs.
    """
    known: dict[tuple[str, str], tuple[LogLocation, Mapping[str, str]]] = {}
    for path, runs in logs:
        for run in runs:
            other, parameters = known.setdefault((run.run, run.stage), (path, run.parameters))
            if other != path and parameters != run.parameters:
                raise LogError(
                    f"run {run.run} has other parameters of {run.stage} in {other} than in {path}; leave one "
                    "of them out, or compute the run again with --run and another name"
                )


def find_new_ids(logs: Iterable[Iterable[Measurement]]) -> list[dict[str, str]]:
    """Return new ids for ids that an earlier log has too: for each log, the new id by the old id.

    Parameters
    ----------
    logs : the measurements of each log; the earliest log first.

    Examples
    --------
    >>> find_new_ids([[Measurement(0, "p001")], [Measurement(9, "p001"), Measurement(9, "p002")]])
    [{}, {'p001': 'p001_2'}]
    """
    taken: set[str] = set()
    renamings = []
    for number, measurements in enumerate(logs, 1):
        ids = list(dict.fromkeys(measurement.id for measurement in measurements))
        new: dict[str, str] = {}
        for name in ids:
            if name in taken:
                new[name] = f"{name}_{number}"
        taken.update(new.get(name, name) for name in ids)
        renamings.append(new)
    return renamings


def rename_ids(measurement: Measurement, ids: Mapping[str, str]) -> Measurement:
    """Return a measurement, a withdrawal, or a re-admission, with the new ids of its log."""

    def new_id(name: str | None) -> str | None:
        return None if name is None else ids.get(name, name)

    return replace(
        measurement,
        id=ids.get(measurement.id, measurement.id),
        withdraws=new_id(measurement.withdraws),
        readmits=new_id(measurement.readmits),
    )
