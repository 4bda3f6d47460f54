"""Search for a board in images from any source, and selection of the images for a calibration."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import LEAST_CORNERS, BoardSighting, BoardView, view_board
from ipsys_log.calibration.board_size import check_charuco_size, check_chessboard_size, describe_other_board
from ipsys_log.calibration.chessboard import fits_in
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Grey

_CELLS = (8, 6)
# Width of a strip along each side of the image, as a share of the image. Distortion is largest there.
_STRIP = 0.15
_ENOUGH_SHARE = 0.6
_ENOUGH_TILT = np.radians(25)
_ENOUGH_TILTED = 3
_ENOUGH_PLACES = 10
# Boards that differ by less than this share of the image diagonal give the same information.
NEAR = 0.03


@dataclass(frozen=True, slots=True)
class ImageCoverage:
    """The coverage of the image and of the board poses by all used corners.

    ``share`` is the share of the image (in 8 x 6 cells) with corners, ``empty_sides`` are the sides of the
    image without corners. ``tilted`` counts the boards with a tilt of 25 degrees or more,
    ``position_count`` the board positions that differ by 3 % of the image. ``widest_rad`` is the greatest
    angle of a corner from the optical axis, or None.
    """

    share: float
    empty_sides: tuple[str, ...]
    tilted: int
    position_count: int
    widest_rad: float | None = None


def measure_coverage(
    pixels: Array,
    size_px: tuple[int, int],
    outlines: Array,
    normals: Array | None = None,
    points_m: Array | None = None,
) -> ImageCoverage:
    """Return the coverage of the image and of the board poses.

    Parameters
    ----------
    pixels : all corners, (n, 2).
    size_px : width and height of the image.
    outlines : outlines of the boards, (f, 4, 2) in px.
    normals : normals of the boards in camera coordinates, (f, 3), if known.
    points_m : the corners in camera coordinates, (n, 3), if known.
    """
    size = np.array(size_px, dtype=np.float64)
    relative = (pixels + 0.5) / size
    cells = np.clip((relative * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
    share = len({tuple(cell) for cell in cells.tolist()}) / (_CELLS[0] * _CELLS[1])
    sides = {
        "left": relative[:, 0] < _STRIP,
        "right": relative[:, 0] > 1 - _STRIP,
        "upper": relative[:, 1] < _STRIP,
        "lower": relative[:, 1] > 1 - _STRIP,
    }
    empty = tuple(name for name, near in sides.items() if not near.any())
    tilted = len(outlines)
    if normals is not None:
        tilted = int((np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1)) >= _ENOUGH_TILT).sum())
    places = int(group_outlines(outlines, NEAR * float(np.hypot(*size))).max()) + 1
    widest = None
    if points_m is not None:
        widest = float(np.arctan2(np.hypot(points_m[:, 0], points_m[:, 1]), points_m[:, 2]).max())
    return ImageCoverage(share, empty, tilted, places, widest)


def group_outlines(outlines: Array, near_px: float) -> NDArray[np.intp]:
    """Return the group of each outline (f, 4, 2).

    An outline joins the group with the nearest first outline, or starts a new group.
    """
    groups: list[int] = []
    leaders: list[Array] = []
    for outline in outlines:
        distances = [float(np.linalg.norm(outline - other, axis=1).mean()) for other in leaders]
        nearest = int(np.argmin(distances)) if distances else 0
        if not distances or not distances[nearest] < near_px:
            nearest = len(leaders)
            leaders.append(outline)
        groups.append(nearest)
    return np.array(groups)


def advise(coverage: ImageCoverage) -> list[str]:
    """Return advice on additional images; an empty list if the images are good."""
    lines = []
    if coverage.empty_sides:
        *most, last = coverage.empty_sides
        sides = f"{', '.join(most)} and {last} edges" if most else f"{last} edge"
        lines.append(f"no board near the {sides} of the image: move it there, too")
    elif coverage.share < _ENOUGH_SHARE:
        lines.append(f"the board covered {coverage.share:.0%} of the image: move it over the whole image")
    if coverage.position_count < _ENOUGH_PLACES:
        places = "position" if coverage.position_count == 1 else "different positions"
        lines.append(f"the board was held at {coverage.position_count} {places}: move it more")
    if coverage.tilted < _ENOUGH_TILTED:
        lines.append(
            f"tilted by 25 degrees or more in {coverage.tilted} pictures: tilt the board to all sides, "
            "because the focal length depends on the tilt"
        )
    return lines


MAX_IMAGES = 50
# Edges are blurred if they are wider than edges in sharp images by this factor, and wider than this limit.
_BLURRED = 2.2
_BLURRED_PX = 1.8
# A board that moves by less than this share of the image diagonal gives no new information.
_SAME = 0.0005


class ExcludedSighting(NamedTuple):
    """An image that is not used, and the reason."""

    name: str
    reason: str


class Selection(NamedTuple):
    """The images for the fit, the bad images, and good images that give no new information."""

    used: list[BoardSighting]
    bad: list[ExcludedSighting]
    spare: list[ExcludedSighting]


def select_images(sightings: Sequence[BoardSighting], board: Board, size_px: tuple[int, int]) -> Selection:
    """Choose images for the calibration from all images that show the board.

    If there are more images than necessary, the next image is the image whose board is farthest from all
    chosen boards. Distances of blurred images have less weight. Outlines that are far apart differ in
    position, size, rotation or tilt.

    Parameters
    ----------
    sightings : detections of the board, in the order of the images.
    board, size_px : the board, and width and height of the images.
    """
    bad, good = [], []
    usual_px = _usual_blur_px(sightings)
    for sighting in sightings:
        reason = _fault(sighting, board, usual_px)
        if reason is None:
            good.append(sighting)
        else:
            bad.append(ExcludedSighting(sighting.name, reason))
    if not good:
        return Selection([], bad, [])
    order, spare = _spread(good, usual_px, _SAME * float(np.hypot(*size_px)))
    return Selection([good[n] for n in sorted(order)], bad, spare)


def _usual_blur_px(sightings: Sequence[BoardSighting]) -> float:
    widths = [s.blur_px for s in sightings if s.blur_px > 0]
    return float(np.quantile(widths, 0.25)) if widths else 0.0


def _fault(sighting: BoardSighting, board: Board, usual_px: float) -> str | None:
    count = len(sighting.ids)
    if (
        count < LEAST_CORNERS
        or min(len(set(line)) for line in board.grid_positions(sighting.ids).T.tolist()) < 2
    ):
        return f"only {count} corners are found" if count < LEAST_CORNERS else "its corners lie on one line"
    if usual_px and sighting.blur_px > max(_BLURRED * usual_px, _BLURRED_PX):
        return f"blurred: edges are {sighting.blur_px:.1f} px wide, but {usual_px:.1f} px in sharp pictures"
    return None


def _spread(
    good: Sequence[BoardSighting], usual_px: float, same_px: float
) -> tuple[list[int], list[ExcludedSighting]]:
    """Return the numbers of the images to use, and the other images with the names of similar images."""
    outlines = np.stack([s.outline for s in good])
    sharp = np.array([min(1.0, usual_px / s.blur_px) if s.blur_px > 0 else 1.0 for s in good])
    order = [int(np.argmax(sharp * [len(s.ids) for s in good]))]
    nearest = np.full(len(good), order[0])
    distances = _distances_px(outlines, outlines[order[0]])
    while len(order) < min(len(good), MAX_IMAGES):
        farthest = int(np.argmax(distances * sharp))
        if distances[farthest] <= same_px:
            break
        order.append(farthest)
        new_distances = _distances_px(outlines, outlines[farthest])
        nearest[new_distances < distances] = farthest
        distances = np.minimum(distances, new_distances)
    used = set(order)
    spare = [
        ExcludedSighting(s.name, f"the board has nearly the same pose as in {good[nearest[n]].name}")
        for n, s in enumerate(good)
        if n not in used
    ]
    return order, spare


def _distances_px(outlines: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean distance of the four corners of each outline (n, 4, 2) from another outline."""
    return np.asarray(np.linalg.norm(outlines - other, axis=2).mean(axis=1))


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
