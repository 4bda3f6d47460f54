"""Exclusion of calibration points of a finished log from all stages, and their re-admission."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ipsys_log.engine.output import write_messages
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.checks import free_id, withdrawal_of
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import MEASUREMENTS_TOPIC, Measurement, Message
from ipsys_log.messages.channels import MEASUREMENTS
from ipsys_log.statistics.calibration_points import withdrawals

_MOST_NAMES = 40


@dataclass(frozen=True, slots=True)
class ExclusionResult:
    """The result of an exclusion or a re-admission.

    Attributes
    ----------
    changed : ids of the measurements that the log now excludes, or re-admits.
    unchanged : ids of the measurements that were excluded, or valid, before; by id, the reason of their
        present exclusion, or "".
    active : number of the valid measurements of the log now.
    """

    changed: tuple[str, ...]
    unchanged: Mapping[str, str]
    active: int


def exclude(path: Path, names: Sequence[str], reason: str) -> ExclusionResult:
    """Withdraw measurements of a finished log: no stage uses them any more, and the log keeps them.

    Parameters
    ----------
    names : ids of measurements, or names of calibration points. The latter name all their measurements.
    reason : is written into the log.

    Raises
    ------
    IpsysError
        A name is not in the log, or there is no reason. The log is unchanged.
    LogError
        The log is locked or cannot be written to.
    """
    return _append(path, names, reason, readmits=False)


def readmit(path: Path, names: Sequence[str], reason: str) -> ExclusionResult:
    """Re-admit withdrawn measurements of a finished log; parameters and errors are those of `exclude`."""
    return _append(path, names, reason, readmits=True)


def place_in_log(measurement: Measurement, earlier: Sequence[Message]) -> Message:
    """Return the message of a measurement, at the end of its stationary interval.

    A message follows all earlier messages about the same measurement.
    """
    end_ns = measurement.timestamp if measurement.still is None else measurement.still.end
    names = {measurement.id, measurement.refers_to} - {None}
    same = [m.log_time_ns + 1 for m in earlier if {m.payload.id, m.payload.refers_to} & names]
    return Message(MEASUREMENTS_TOPIC, max([end_ns, *same]), measurement.timestamp, measurement)


def _append(path: Path, names: Sequence[str], reason: str, readmits: bool) -> ExclusionResult:
    if not reason.strip():
        raise IpsysError('--reason: is empty; say why, such as --reason "the tape sagged"')
    with LogWriter.append(path) as writer:  # no other process adds measurements from here on
        with Session([path]) as session:
            messages = list(session.messages(session.topics(MEASUREMENTS)))
        history: list[Measurement] = [message.payload for message in messages]
        points = {measurement.id: measurement for measurement in history if measurement.is_point}
        excluded = withdrawals(history)
        chosen = _chosen_ids(path, points, names)
        changed = [name for name in chosen if (name in excluded) == readmits]
        for name in changed:
            payload = (
                _readmission_of(history, points[name], reason.strip())
                if readmits
                else withdrawal_of(history, name, reason.strip())
            )
            messages.append(place_in_log(payload, messages))
            history.append(payload)
        write_messages(writer, messages[len(messages) - len(changed) :])
    unchanged = {
        name: (excluded[name].reason or "") if name in excluded else ""
        for name in chosen
        if name not in changed
    }
    return ExclusionResult(tuple(changed), unchanged, len(points.keys() - withdrawals(history).keys()))


def _readmission_of(history: Sequence[Measurement], point: Measurement, reason: str) -> Measurement:
    message_id = free_id(history, f"{point.id}_readmitted")
    return Measurement(point.timestamp, message_id, readmits=point.id, reason=reason)


def _chosen_ids(path: Path, points: dict[str, Measurement], names: Sequence[str]) -> list[str]:
    """Return the ids of the named measurements, each once, in the order of the names.

    Raises
    ------
    IpsysError
        A name is neither an id nor a calibration point; the text lists the names of the log.
    """
    chosen: dict[str, None] = {}
    for name in names:
        ids = [key for key, point in points.items() if name in (key, point.calibration_point)]
        if not ids:
            raise IpsysError(f"{path}: has no calibration point {name!r}; it has {_listed(points)}")
        chosen |= dict.fromkeys(ids)
    return list(chosen)


def _listed(points: dict[str, Measurement]) -> str:
    names = list(dict.fromkeys(point.calibration_point or key for key, point in points.items()))
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return (", ".join(names[:_MOST_NAMES]) or "none") + more
