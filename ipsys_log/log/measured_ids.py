"""Measurements of several logs that are read as one: each log begins at p001."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from ipsys_log.messages import Measurement

__all__ = ["other_ids", "renamed"]


def other_ids(logs: Iterable[Iterable[Measurement]]) -> list[dict[str, str]]:
    """New ids where an earlier log has the same: for each log, the new one by the old one.

    Parameters
    ----------
    logs : the measurements of each log; the earliest log first.

    Examples
    --------
    >>> other_ids([[Measurement(0, "p001")], [Measurement(9, "p001"), Measurement(9, "p002")]])
    [{}, {'p001': 'p001_2'}]
    """
    taken: set[str] = set()
    found = []
    for number, measurements in enumerate(logs, 1):
        here = list(dict.fromkeys(one.id for one in measurements))
        new: dict[str, str] = {}
        for name in here:
            if name in taken:
                new[name] = f"{name}_{number}"
        taken.update(new.get(name, name) for name in here)
        found.append(new)
    return found


def renamed(measurement: Measurement, ids: Mapping[str, str]) -> Measurement:
    """A measurement, or the end of one, under the new ids of its log."""
    withdrawn = measurement.withdraws
    return replace(
        measurement,
        id=ids.get(measurement.id, measurement.id),
        withdraws=None if withdrawn is None else ids.get(withdrawn, withdrawn),
    )
