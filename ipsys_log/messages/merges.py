"""Payload of a merged log: the record of the merge."""

from __future__ import annotations

from dataclasses import dataclass, field

from ipsys_log.messages.cuts import ChannelCut
from ipsys_log.messages.message import TimeNs


@dataclass(frozen=True, slots=True, eq=False)
class MergedLog:
    """A log in a merged log: its name, the offset of its times, and its channels there.

    ``offset_ns`` was added to all times of the log; ``offset_sigma_s`` is the standard deviation of an
    estimated offset. ``renamed_runs`` are the new names of runs by their old names.
    """

    name: str
    offset_ns: int = 0
    offset_sigma_s: float | None = None
    channels: tuple[ChannelCut, ...] = ()
    renamed_runs: dict[str, str] = field(default_factory=dict)

    @property
    def logs(self) -> tuple[str, ...]:
        """The name of the log, as in the record of a cut."""
        return (self.name,)


@dataclass(frozen=True, slots=True, eq=False)
class Merge:
    """The record of a merge: the logs in their order."""

    timestamp: TimeNs
    logs: tuple[MergedLog, ...] = ()
