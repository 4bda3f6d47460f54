"""The seat of the operator: one device at a time changes things, until another one takes over."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Any

from ipsys_log.errors import IpsysError

_NUMBERS = 1 << 30


class OperatorSeat:
    """The seat of the operator. For one thread.

    Numbers begin anywhere: a page of an earlier server does not have the number of a present device.

    Attributes
    ----------
    number : the number of the device that operates; 0: none.
    version : increases with each change.
    """

    def __init__(self) -> None:
        self.number, self.version = 0, 0
        self._last = secrets.randbelow(_NUMBERS)

    def claim(self, take_over: bool) -> int:
        """Return the number of a new operator.

        Raises
        ------
        IpsysError
            Another device operates, and the new one does not take over.
        """
        if self.number and not take_over:
            raise IpsysError(_OCCUPIED)
        self._last += 1
        self.number = self._last
        self.version += 1
        return self.number

    def release(self, number: int) -> None:
        """End the operation by a device, if it still operates."""
        if number == self.number:
            self.number = 0
            self.version += 1

    def check(self, number: int) -> None:
        """Check that a device operates.

        Raises
        ------
        IpsysError
            Another device operates, or none.
        """
        if not number or number != self.number:
            raise IpsysError(_OCCUPIED)


_OCCUPIED = "another device operates; press 'Take over' to operate from this device"


def operator_of(body: Mapping[str, Any], key: str = "operator") -> int:
    """Return the number of the device that sends a request; 0 if it names none."""
    value = body.get(key)
    return value if isinstance(value, int) and not isinstance(value, bool) else 0


def answer_claim(seat: OperatorSeat, body: Mapping[str, Any]) -> dict[str, int]:
    """Claim the seat for a device, or release it; return the answer to its request.

    Raises
    ------
    IpsysError
        Another device operates, and the new one does not take over.
    """
    if "release" in body:
        seat.release(operator_of(body, "release"))
        return {}
    return {"operator": seat.claim(body.get("take_over") is True)}
