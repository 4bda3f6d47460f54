"""Look for a board in pictures, whatever they come from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
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
# Pictures of another size are left out where so many are of one.
_MOST_ARE = 0.75


class NotSeenError(IpsysError):
    """A board that is in none of the pictures."""


# Width and height in px; of a picture.
Size = tuple[int, int]
Sized = tuple[str, Size]


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
    trying: Callable[[int, int], None] = lambda done, total: None,
) -> Looked:
    """Look for the board in all pictures.

    Parameters
    ----------
    pictures : names and grey pictures, None for one that cannot be read.
    board : what to look for.
    total : how many there are about; 0 where that is not known.
    where : they come from, for messages.
    progress : called with the pictures done.
    trying : called with the other boards looked for, and all of them, where this one is not seen.

    Raises
    ------
    IpsysError
        Where pictures are of several sizes, none of which most are of; none can be read; or the board is a
        part of what is seen.
    NotSeenError
        Where the board is in none of them; it says what is.
    """
    count = 0
    sizes: list[Sized] = []
    sightings: list[tuple[Size, Sighting]] = []
    unreadable: list[Dropped] = []
    some: list[Grey] = []
    shown: list[Grey] = []
    for name, grey in pictures:
        count += 1
        if grey is None:
            unreadable.append(Dropped(name, "cannot be read"))
            continue
        size = (grey.shape[1], grey.shape[0])
        sizes.append((name, size))
        sighting = find_board(name, grey, board, thorough=0 < total <= _THOROUGH)
        if sighting is not None:
            sightings.append((size, sighting))
            shown += [grey] if len(shown) < _CHECKED else []
        elif not sightings:
            _remember(some, grey, count, total)
        progress(count)
    if not sizes:
        raise IpsysError(f"{where}: none of {count} pictures can be read")
    usual, strange = _usual_size(sizes, where)
    if not sightings:
        found = hint(some, board, trying)
        raise NotSeenError(f"{where}: {board} is not seen in any of {count} pictures{found}")
    check_whole(shown, board, where)
    seen = tuple(sighting for size, sighting in sightings if size == usual)
    return Looked(count, usual, seen, (*unreadable, *strange))


def _usual_size(sizes: Sequence[Sized], where: str) -> tuple[Size, list[Dropped]]:
    """The size that most pictures have, and the few of another; an error where these are not few."""
    usual, many = Counter(size for _, size in sizes).most_common(1)[0]
    strange = [(name, size) for name, size in sizes if size != usual]
    if many < _MOST_ARE * len(sizes):
        like = next(name for name, size in sizes if size == usual)
        raise IpsysError(
            f"{where}: {_sized(*strange[0])} and {_sized(like, usual)}; "
            "a lens is calibrated at one size: take out one kind"
        )
    reason = "is {} x {} px, most are {} x {}"
    return usual, [Dropped(name, reason.format(*size, *usual)) for name, size in strange]


def _sized(name: str, size: Size) -> str:
    return f"{name} is {size[0]} x {size[1]} px"


def _remember(some: list[Grey], grey: Grey, count: int, total: int) -> None:
    """Keep a few pictures, spread over all of them, to find out what they show instead."""
    if count % max(1, -(-total // _HINTED)) == 0:
        some.append(grey)
        if len(some) > 2 * _HINTED:
            del some[::2]
