"""Look for a board in pictures, whatever they come from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import Grey, Sighting, View, view_board
from ipsys_log.calibration.board_size import check_charuco_size, check_chessboard_size, hint
from ipsys_log.calibration.chessboard import fits_in
from ipsys_log.calibration.image_selection import Dropped
from ipsys_log.errors import IpsysError

__all__ = ["Looked", "NotSeenError", "Size", "check_sizes", "look"]

# Up to so many pictures are looked at thoroughly: more come from a video, which has others.
_THOROUGH = 100
_HINTED = 8
_CHECKED = 8
# Pictures of another size are left out where so many are of one.
_MOST_ARE = 0.75
_SIZES_NAMED, _EXAMPLES = 4, 2


class NotSeenError(IpsysError):
    """A board that is in none of the pictures."""


# Width and height in px.
Size = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """All pictures of a camera: number, size, sightings, unreadable pictures, pictures without the board."""

    count: int
    size_px: tuple[int, int]
    sightings: tuple[Sighting, ...]
    unreadable: tuple[Dropped, ...]
    unseen: tuple[Dropped, ...] = ()


class _Seen(NamedTuple):
    """One readable picture: its name, its size in px, and the view of the board."""

    name: str
    size: Size
    view: View


def look(
    pictures: Iterable[tuple[str, Grey | None]],
    board: Board,
    total: int,
    where: str,
    progress: Callable[[int], None] = lambda done: None,
    trying: Callable[[int, int], None] = lambda done, total: None,
    insist: bool = False,
) -> Looked:
    """Detect the board in all pictures.

    Parameters
    ----------
    pictures : names and grey pictures, None for an unreadable one.
    board : to search for.
    total : approximate number of pictures; 0 if it is not known.
    where : source of the pictures, for messages.
    progress : called with the number of pictures done.
    trying : called with the number of other boards tried, and their total, if this one is not seen.
    insist : accept the size of the board, even if the pictures contradict it.

    Raises
    ------
    IpsysError
        Pictures have several sizes, and no size has the majority; no picture can be read; or most pictures
        show a larger board.
    NotSeenError
        No picture shows the board; the text says what they show.
    """
    count = 0
    views: list[_Seen] = []
    unreadable: list[Dropped] = []
    without, shown = _Sample(_HINTED, total), _Sample(_CHECKED, total)
    for name, grey in pictures:
        count += 1
        if grey is None:
            unreadable.append(Dropped(name, "cannot be read"))
            continue
        view = view_board(name, grey, board, thorough=0 < total <= _THOROUGH)
        views.append(_Seen(name, (grey.shape[1], grey.shape[0]), view))
        (without if view.sighting is None else shown).add(grey)
        progress(count)
    if not views:
        raise IpsysError(f"{where}: none of {count} pictures can be read")
    usual = check_sizes([(one.name, one.size) for one in views], where)
    if all(one.view.sighting is None for one in views):
        found = hint(without.pictures, board, trying, [one.view.grid for one in views])
        raise NotSeenError(f"{where}: {board} is not seen in any of {count} pictures{found}")
    if not insist and board.marker_scale is None:
        check_chessboard_size([one.view.grid for one in views], board, where)
    elif not insist:
        check_charuco_size(shown.pictures, board, where)
    ordinary = [one for one in views if one.size == usual]
    seen = [one.view.sighting for one in ordinary if one.view.sighting is not None]
    unseen = [Dropped(one.name, _reason(one.view, board)) for one in ordinary if one.view.sighting is None]
    return Looked(count, usual, tuple(seen), (*unreadable, *_strange(views, usual)), tuple(unseen))


def _reason(view: View, board: Board) -> str:
    if view.grid is None:
        return "the board is not seen"
    columns, rows = view.grid
    if fits_in(view.grid, board.grid):
        return f"only {columns} x {rows} of its corners are seen"
    return f"a grid of {columns} x {rows} corners is seen instead"


def check_sizes(sizes: Sequence[tuple[str, Size]], where: str) -> Size:
    """Return the size in px that most pictures have.

    Parameters
    ----------
    sizes : name and size of each picture, at least one.
    where : source of the pictures, for messages.

    Raises
    ------
    IpsysError
        More than a few pictures have another size.
    """
    counts = Counter(size for _, size in sizes).most_common()
    if counts[0][1] >= _MOST_ARE * len(sizes):
        return counts[0][0]
    kinds = []
    for size, count in counts[:_SIZES_NAMED]:
        names = [name for name, other in sizes if other == size][:_EXAMPLES]
        kinds.append(
            f"{count} of {size[0]} x {size[1]} px ({', '.join(names)}{' ...' * (count > _EXAMPLES)})"
        )
    kinds += [f"{len(counts) - len(kinds)} more"] * (len(counts) > len(kinds))
    raise IpsysError(
        f"{where}: pictures have {len(counts)} sizes: {'; '.join(kinds)}. "
        "A calibration needs one size: put the pictures of each size into a separate folder"
    )


def _strange(views: Sequence[_Seen], usual: Size) -> list[Dropped]:
    reason = "is {} x {} px, most are {} x {}"
    return [Dropped(one.name, reason.format(*one.size, *usual)) for one in views if one.size != usual]


class _Sample:
    """Return a few pictures, spread over all of them."""

    def __init__(self, wanted: int, total: int) -> None:
        self.pictures: list[Grey] = []
        self._stride, self._wanted, self._count = max(1, -(-total // (2 * wanted))), wanted, 0

    def add(self, grey: Grey) -> None:
        if self._count % self._stride == 0:
            self.pictures.append(grey)
            if len(self.pictures) > 2 * self._wanted:
                del self.pictures[::2]
                self._stride *= 2
        self._count += 1
