"""Stand-in so that the package imports; whoever builds this file overwrites it."""

from __future__ import annotations

from typing import Any

from ipsys_log.messages import Suspect


def find_suspects(leave_one_out: Any, places: Any) -> tuple[Suspect, ...]:
    return ()
