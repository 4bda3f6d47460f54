"""Payload of a part of a log: the record of the cut."""

from __future__ import annotations

from dataclasses import dataclass, field

from ipsys_log.messages.message import TimeNs


@dataclass(frozen=True, slots=True)
class ChannelCut:
    """A channel before a cut (``messages``, ``hash``) and after it (``kept``, ``kept_hash``).

    ``left_out`` says that the options exclude the whole channel. In a merged log, ``shared`` says that the
    channel also has messages of other logs, or was changed.
    """

    topic: str
    messages: int
    hash: str
    kept: int
    kept_hash: str | None = None
    left_out: bool = False
    shared: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """The record of a cut: the names of the logs that were cut, the options, and each channel."""

    timestamp: TimeNs
    logs: tuple[str, ...] = ()
    options: dict[str, str] = field(default_factory=dict)
    channels: tuple[ChannelCut, ...] = ()
