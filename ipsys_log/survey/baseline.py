"""The distance AB between the first two reference points, read with the tape of the calibration points."""

from __future__ import annotations

from collections.abc import Sequence

from ipsys_log.analysis.pairs import active_baselines
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Distance, Measurement, Rig
from ipsys_log.survey.checks import free_id
from ipsys_log.survey.entry import check_references, parse_baseline


def baseline_names(rig: Rig) -> tuple[str, str]:
    """Return the names of the first two reference points."""
    first, second, *_ = rig.reference_points
    return first.name, second.name


def needs_baseline(rig: Rig, history: Sequence[Measurement]) -> bool:
    """Return whether a reading of AB would count, and there is none yet."""
    return rig.ab_sigma_m is not None and not active_baselines(history)


def read_baseline(text: str, rig: Rig, history: Sequence[Measurement], time_ns: int) -> Measurement:
    """Return the measurement of a typed distance AB in cm.

    Raises
    ------
    IpsysError
        The text is not a number, or contradicts the reference points of the rig.

    Examples
    --------
    >>> from ipsys_log.messages import ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points)
    >>> reading = read_baseline("200,3", rig, [], 0)
    >>> reading.id, reading.from_reference, reading.distances[0].distance_m
    ('ab', 'A', 2.003)
    """
    check_references(rig)
    distance_m, fault = parse_baseline(text, rig)
    if fault is not None:
        raise IpsysError(fault.text)
    first, second = baseline_names(rig)
    name = free_id(history, "ab")
    return Measurement(time_ns, name, distances=(Distance(second, distance_m),), from_reference=first)
