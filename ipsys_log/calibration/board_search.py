"""Search for a board in images from any source."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting, BoardView, view_board
from ipsys_log.calibration.board_size import check_charuco_size, check_chessboard_size, describe_other_board
from ipsys_log.calibration.chessboard import fits_in
from ipsys_log.calibration.image_selection import ExcludedSighting
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Grey

# Up to this number of images, the search is thorough. More images come from a video, which has enough images.
_THOROUGH = 100
_HINTED = 8
_CHECKED = 8
# Images of another size are left out if at least this share of the images has one size.
_MOST_ARE = 0.75
_SIZES_NAMED, _EXAMPLES = 4, 2


class NotSeenError(IpsysError):
    """A board that no image shows."""


# Width and height in px.
Size = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """All images of a camera: number, size, sightings, unreadable images, and images without the board."""

    count: int
    size_px: tuple[int, int]
    sightings: tuple[BoardSighting, ...]
    unreadable: tuple[ExcludedSighting, ...]
    unseen: tuple[ExcludedSighting, ...] = ()


class ImageView(NamedTuple):
    """One readable image: its name, its size in px, and the view of the board."""

    name: str
    size: Size
    view: BoardView


def search_images(
    images: Iterable[tuple[str, Grey | None]],
    board: Board,
    total: int,
    source: str,
    progress: Callable[[int], None] = lambda done: None,
    trying: Callable[[int, int], None] = lambda done, total: None,
    force: bool = False,
) -> SearchResult:
    """Detect the board in all images.

    Parameters
    ----------
    images : names and grey images, None for an unreadable image.
    board : the board to search for.
    total : approximate number of images; 0 if it is not known.
    source : source of the images, for messages.
    progress : called with the number of searched images.
    trying : called with the number of other boards tried, and their total, if no image shows the board.
    force : accept the size of the board, even if the images contradict it.

    Raises
    ------
    IpsysError
        Images have several sizes, and no size has the majority; no image can be read; or most images
        show a larger board.
    NotSeenError
        No image shows the board; the text says which board the images show.
    """
    count = 0
    views: list[ImageView] = []
    unreadable: list[ExcludedSighting] = []
    without, shown = _Sample(_HINTED, total), _Sample(_CHECKED, total)
    for name, grey in images:
        count += 1
        if grey is None:
            unreadable.append(ExcludedSighting(name, "cannot be read"))
            continue
        view = view_board(name, grey, board, thorough=0 < total <= _THOROUGH)
        views.append(ImageView(name, (grey.shape[1], grey.shape[0]), view))
        (without if view.sighting is None else shown).add(grey)
        progress(count)
    if not views:
        raise IpsysError(f"{source}: none of the {count} pictures can be read; check the files")
    usual_size = check_sizes([(viewed.name, viewed.size) for viewed in views], source)
    if all(viewed.view.sighting is None for viewed in views):
        hint_text = describe_other_board(
            without.images, board, trying, [viewed.view.grid for viewed in views]
        )
        raise NotSeenError(f"{source}: {board} is not found in any of the {count} pictures{hint_text}")
    if not force and board.marker_scale is None:
        check_chessboard_size([viewed.view.grid for viewed in views], board, source)
    elif not force:
        check_charuco_size(shown.images, board, source)
    ordinary = [viewed for viewed in views if viewed.size == usual_size]
    sightings = [viewed.view.sighting for viewed in ordinary if viewed.view.sighting is not None]
    unseen = [
        ExcludedSighting(viewed.name, _reason(viewed.view, board))
        for viewed in ordinary
        if viewed.view.sighting is None
    ]
    return SearchResult(
        count, usual_size, tuple(sightings), (*unreadable, *_strange(views, usual_size)), tuple(unseen)
    )


def _reason(view: BoardView, board: Board) -> str:
    if view.grid is None:
        return "the board is not found"
    columns, rows = view.grid
    if fits_in(view.grid, board.grid):
        return f"only {columns} x {rows} of its corners are found"
    return f"a grid of {columns} x {rows} corners is found instead"


def check_sizes(sizes: Sequence[tuple[str, Size]], source: str) -> Size:
    """Return the size in px that most images have.

    Parameters
    ----------
    sizes : name and size of each image, at least one.
    source : source of the images, for messages.

    Raises
    ------
    IpsysError
        More than a few images have another size.
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
        f"{source}: pictures have {len(counts)} sizes: {'; '.join(kinds)}. "
        "A calibration needs one size: put the pictures of each size into a separate folder"
    )


def _strange(views: Sequence[ImageView], usual: Size) -> list[ExcludedSighting]:
    reason = "is {} x {} px, most are {} x {}"
    return [
        ExcludedSighting(viewed.name, reason.format(*viewed.size, *usual))
        for viewed in views
        if viewed.size != usual
    ]


class _Sample:
    """A small sample of images, spread over all images."""

    def __init__(self, wanted: int, total: int) -> None:
        self.images: list[Grey] = []
        self._stride, self._wanted, self._count = max(1, -(-total // (2 * wanted))), wanted, 0

    def add(self, grey: Grey) -> None:
        if self._count % self._stride == 0:
            self.images.append(grey)
            if len(self.images) > 2 * self._wanted:
                del self.images[::2]
                self._stride *= 2
        self._count += 1
