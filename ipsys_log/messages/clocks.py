"""Payload about the clock of a node, a host with a camera."""

from __future__ import annotations

from dataclasses import dataclass

from ipsys_log.messages.message import TimeNs


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """The clock of the node of a camera against the clock of the centre, which records.

    ``timestamp`` is by the clock of the centre. ``session`` is new at each start of the node. At
    ``node_time``, ``offset_ns`` is the time of the centre minus the time of the node; ``drift`` is its change
    in s/s. The true offset lies within ``bound_ns`` of it, whatever the delays of the network are.
    """

    timestamp: TimeNs
    camera: str
    session: str
    node_time: TimeNs
    offset_ns: int
    drift: float
    bound_ns: int
    exchanges: int
