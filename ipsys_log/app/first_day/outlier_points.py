"""Calibration points that contradict the fit of a lab: the log of each, and its exclusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ipsys_log.app.report.accuracy import Accuracy, gather_outliers
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.from_log import exclude
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import find_new_ids
from ipsys_log.messages import Measurement
from ipsys_log.messages.channels import MEASUREMENTS
from ipsys_log.statistics.calibration_points import active_measurements
from ipsys_log.units import CM_PER_M

_REASON = "it contradicts the fit (setup page)"


@dataclass(frozen=True, slots=True)
class OutlierPoint:
    """A calibration point that contradicts the fit.

    Attributes
    ----------
    log, point : name of its log, and its id in this log.
    error_cm : distance between the measured position and that of the fit without the point.
    text : a possible explanation; "" if no simple mistake explains it.
    """

    log: str
    point: str
    error_cm: float
    text: str


def find_outlier_points(paths: Sequence[Path], accuracies: Sequence[Accuracy]) -> tuple[OutlierPoint, ...]:
    """Return the calibration points that contradict the fit and are not excluded, the worst first.

    Raises
    ------
    IpsysError
        A log cannot be read.
    """
    suspects = [suspect for suspect, _ in gather_outliers(accuracies)]
    origins = _origins(paths) if suspects else {}
    return tuple(
        OutlierPoint(
            origins[suspect.measurement][0].name,
            origins[suspect.measurement][1],
            float(np.linalg.norm(suspect.residual_m)) * CM_PER_M,
            suspect.text or "",
        )
        for suspect in suspects
        if suspect.measurement in origins
    )


def exclude_outlier(paths: Sequence[Path], log: str, point: str) -> None:
    """Exclude a calibration point from all stages (``ipsys exclude LOG POINT``); nothing is erased.

    Parameters
    ----------
    paths : the logs that may be changed.
    log : the name of one of them.

    Raises
    ------
    IpsysError
        There is no such log or no such point.
    """
    found = next((path for path in paths if path.name == log), None)
    if found is None:
        raise IpsysError(f"the folder has no log {log!r} with calibration points; reload this page")
    exclude(found, [point], _REASON)


def _origins(paths: Sequence[Path]) -> dict[str, tuple[Path, str]]:
    """Return the log of each valid point and its id in it, by the id in the session of all logs."""
    measured = sorted((found for path in paths if (found := _measured(path))), key=lambda one: one[0])
    new_ids = find_new_ids([list(payloads) for _, _, payloads in measured])
    return {
        ids.get(payload.id, payload.id): (path, payload.id)
        for (_, path, payloads), ids in zip(measured, new_ids, strict=True)
        for payload in active_measurements(payloads)
    }


def _measured(path: Path) -> tuple[int, Path, tuple[Measurement, ...]] | None:
    """Return the time of the first measurement, and all measurements; None without any."""
    with Session([path]) as session:
        messages = list(session.messages(session.topics(MEASUREMENTS)))
    if not messages:
        return None
    return messages[0].log_time_ns, path, tuple(message.payload for message in messages)
