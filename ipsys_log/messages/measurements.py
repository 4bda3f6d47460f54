"""Payloads of the tape measurements: calibration points."""

from __future__ import annotations

from dataclasses import dataclass

from ipsys_log.messages.message import TimeNs


@dataclass(frozen=True, slots=True)
class Distance:
    reference: str
    distance_m: float
    sigma_m: float | None = None


@dataclass(frozen=True, slots=True)
class Interval:
    start: TimeNs
    end: TimeNs


@dataclass(frozen=True, slots=True)
class WorldPoint:
    x_m: float
    y_m: float
    z_m: float


@dataclass(frozen=True, slots=True)
class Measurement:
    """A tape measurement of one marker at one calibration point; or a baseline, a withdrawal, a re-admission.

    A message with ``from_reference`` is a baseline: distances from this reference point to others, read with
    the same tape. A message with ``withdraws`` or ``readmits`` has the id of a measurement there, and perhaps
    a reason. The last message about a measurement counts.
    """

    timestamp: TimeNs
    id: str
    withdraws: str | None = None
    marker_id: int | None = None
    distances: tuple[Distance, ...] = ()
    side: str | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None
    still: Interval | None = None
    point: WorldPoint | None = None
    splits: tuple[str, ...] = ()
    calibration_point: str | None = None
    readmits: str | None = None
    reason: str | None = None
    from_reference: str | None = None

    @property
    def is_point(self) -> bool:
        """Return whether the message is a measurement of a marker, and nothing else."""
        return self.refers_to is None and self.from_reference is None

    @property
    def refers_to(self) -> str | None:
        """The id of the measurement that this message withdraws or re-admits; None for a measurement."""
        return self.withdraws if self.withdraws is not None else self.readmits
