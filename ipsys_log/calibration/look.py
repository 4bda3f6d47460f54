"""Look for a board in pictures, whatever they come from."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ipsys_log.calibration.boards import Board
from ipsys_log.calibration.choose import Dropped
from ipsys_log.calibration.hints import check_whole, hint
from ipsys_log.calibration.sighting import Grey, Sighting, find_board
from ipsys_log.errors import IpsysError

__all__ = ["Looked", "NotSeenError", "look"]

# Up to so many pictures are looked at thoroughly: more come from a video, which has others.
_THOROUGH = 100
_HINTED = 8
_CHECKED = 3


class NotSeenError(IpsysError):
    """A board that is in none of the pictures."""


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What was seen of the board: pictures looked at, their size, the sightings, and what was unreadable."""

    count: int
    size_px: tuple[int, int]
    sightings: tuple[Sighting, ...]
    unreadable: tuple[Dropped, ...]


def look(
    pictures: Iterable[tuple[str, Grey | None]],
    board: Board,
    total: int,
    where: str,
    progress: Callable[[int], None] = lambda done: None,
) -> Looked:
    """Look for the board in all pictures.

    Parameters
    ----------
    pictures : names and grey pictures, None for one that cannot be read.
    board : what to look for.
    total : how many there are about; 0 where that is not known.
    where : they come from, for messages.
    progress : called with the pictures done.

    Raises
    ------
    IpsysError
        Where pictures are of different sizes, none can be read, or the board is a part of what is seen.
    NotSeenError
        Where the board is in none of them; it says what is.
    """
    size: tuple[int, int] | None = None
    first, count = "", 0
    sightings: list[Sighting] = []
    unreadable: list[Dropped] = []
    some: list[Grey] = []
    shown: list[Grey] = []
    for name, grey in pictures:
        count += 1
        if grey is None:
            unreadable.append(Dropped(name, "cannot be read"))
            continue
        here = (grey.shape[1], grey.shape[0])
        _check_same(size, here, first, name, where)
        size, first = here, first or name
        sighting = find_board(name, grey, board, thorough=0 < total <= _THOROUGH)
        if sighting is not None:
            sightings.append(sighting)
            shown += [grey] if len(shown) < _CHECKED else []
        elif not sightings:
            _remember(some, grey, count, total)
        progress(count)
    if size is None:
        raise IpsysError(f"{where}: none of {count} pictures can be read")
    if not sightings:
        found = hint(some, board)
        raise NotSeenError(f"{where}: {board} is not seen in any of {count} pictures{found}")
    check_whole(shown, board, where)
    return Looked(count, size, tuple(sightings), tuple(unreadable))


def _check_same(
    size: tuple[int, int] | None, here: tuple[int, int], first: str, name: str, where: str
) -> None:
    if size is not None and here != size:
        raise IpsysError(
            f"{where}: {name} is {here[0]} x {here[1]} px and {first} is {size[0]} x {size[1]}; "
            "a lens is calibrated at one size: take out one kind"
        )


def _remember(some: list[Grey], grey: Grey, count: int, total: int) -> None:
    """Keep a few pictures, spread over all of them, to find out what they show instead."""
    if count % max(1, -(-total // _HINTED)) == 0:
        some.append(grey)
        if len(some) > 2 * _HINTED:
            del some[::2]
