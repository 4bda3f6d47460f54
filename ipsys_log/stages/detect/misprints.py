"""Prints that are no markers of the rig: mirrored, negative, of another dictionary, or with a wider border.

Squares that no marker explains are read again with other grids and patterns. Only exact patterns with clear
cells count, and more of them than random cells give, so that other squares are not taken for prints.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from math import comb
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Grey
from ipsys_log.messages.events import MIRRORED, OTHER_PRINTS
from ipsys_log.stages.detect.cells import read_cells
from ipsys_log.stages.detect.search import find_squares

Bits = NDArray[np.uint8]

# Kinds of misprints, besides mirrored ones.
_NEGATIVE, _WIDE, _FOREIGN = "negative", "wide border", "dictionary"

# Least difference of black and white, in grey levels, and largest distance of a cell from both as a share of
# it. Squares of other objects have cells between both (test_squares_without_a_pattern_are_no_prints).
_CONTRAST, _CLEAR = 25.0, 0.25
# Chance that random squares fit an explanation as well: 6 % of them are ids of DICT_4X4_1000. The second
# bound holds if all squares fit, as in a lab with few prints.
_CHANCE, _CHANCE_OF_ALL = 0.001, 0.01
# Cells of a side without the border.
_CELLS = (4, 5, 6, 7)
# Dictionaries of square prints: the largest of each family, and the sizes of its parts.
_SIZES = (50, 100, 250, 1000)
_FAMILIES = (
    *(f"DICT_{n}X{n}_1000" for n in (4, 5, 6, 7)),
    *("DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9"),
    *("DICT_APRILTAG_36h10", "DICT_APRILTAG_36h11", "DICT_ARUCO_MIP_36h12"),
)


class Misprints(NamedTuple):
    """Prints of one image that are no markers of the rig: the explanation that fits most of them.

    ``ids`` are theirs in the dictionary that fits. ``advice`` says what they are and what to do. ``kind`` is
    that of the event. ``symmetric`` are the ids of the rig's dictionary whose mirror image is an id, too.
    """

    kind: str
    ids: tuple[int, ...]
    advice: str
    symmetric: tuple[int, ...]


class Inspection:
    """The search of one camera for misprints: in few of its images, ever fewer.

    Images with a marker that cannot be measured are counted apart: the marker may be another print.
    """

    def __init__(self) -> None:
        self._images = {False: 0, True: 0}

    def __call__(
        self,
        grey: Grey,
        dictionary: str,
        markers_px: Sequence[Array],
        squares_px: Array | None = None,
        *,
        has_rejections: bool = False,
    ) -> Misprints | None:
        """Return the misprints among the squares in an image that are none of the measured markers.

        Parameters
        ----------
        markers_px : corners (4, 2) of the measured markers.
        squares_px : corners (n, 4, 2) of all squares, if they are known.
        has_rejections : the image has a marker that cannot be measured.
        """
        self._images[has_rejections] += 1
        images = self._images[has_rejections]
        if images & (images - 1):
            return None
        if squares_px is None:
            squares_px = find_squares(grey)
        unexplained_px = _unexplained(squares_px, markers_px)
        return find_misprints(grey, dictionary, unexplained_px, has_markers=bool(markers_px))


def find_misprints(
    grey: Grey, dictionary: str, squares_px: Array, *, has_markers: bool = False
) -> Misprints | None:
    """Return the explanation of most squares (n, 4, 2), or None; images with markers have no negatives."""
    found = [one for one in _explain(grey, squares_px, dictionary) if one.is_certain]
    if not found and not has_markers:
        inverse, size = 255 - grey, _size(dictionary)
        prints = _clear_prints(inverse, find_squares(inverse), size, 1)
        negative = _Explanation.of(_NEGATIVE, dictionary, prints, _words(dictionary), _patterns(prints))
        found = [negative] if negative.is_certain else []
    if not found:
        return None
    # The first kind is the likeliest if counts are equal: one dictionary has all prints of a lab.
    order = (MIRRORED, _NEGATIVE, _WIDE, _FOREIGN)
    best = min(found, key=lambda one: (-len(one.ids), order.index(one.kind), one.name))
    ids = tuple(sorted(best.ids))
    kind = MIRRORED if best.kind == MIRRORED else OTHER_PRINTS
    return Misprints(kind, ids, _advice(best.kind, best.name, ids, dictionary), _symmetric_ids(dictionary))


class _Explanation(NamedTuple):
    """An explanation of clear squares.

    ``ids`` are those of the squares that fit; ``share`` is that of random squares that fit. ``patterns`` is
    the number of different squares.
    """

    kind: str
    name: str
    ids: set[int]
    patterns: int
    share: float

    @classmethod
    def of(
        cls, kind: str, name: str, prints: Sequence[Bits], words: Mapping[bytes, int], patterns: int
    ) -> _Explanation:
        ids = {words[bits.tobytes()] for bits in prints if bits.tobytes() in words}
        return cls(kind, name, ids, patterns, len(words) / 2.0 ** (_size(name) ** 2))

    @property
    def is_certain(self) -> bool:
        """True if random squares hardly fit as often."""
        fits, count, p = len(self.ids), self.patterns, self.share
        chance = sum(comb(count, n) * p**n * (1 - p) ** (count - n) for n in range(fits, count + 1))
        return fits > 0 and chance < (_CHANCE_OF_ALL if fits == count else _CHANCE)


@cache
def _symmetric_ids(dictionary: str) -> tuple[int, ...]:
    words, size = _words(dictionary), _size(dictionary)
    mirrored = {n: np.frombuffer(bits, dtype=np.uint8).reshape(size, size).T for bits, n in words.items()}
    return tuple(sorted(n for n, bits in mirrored.items() if bits.tobytes() in words))


def _unexplained(squares_px: Array, markers_px: Sequence[Array]) -> Array:
    """Return the squares (n, 4, 2) whose middle is in the box of no marker."""
    middles = squares_px.mean(axis=1)
    left = np.ones(len(squares_px), dtype=bool)
    for corners_px in markers_px:
        inside = (middles > corners_px.min(axis=0)) & (middles < corners_px.max(axis=0))
        left &= ~inside.all(axis=1)
    return squares_px[left]


def _explain(grey: Grey, squares_px: Array, dictionary: str) -> Iterator[_Explanation]:
    """Yield possible explanations of squares."""
    own = _words(dictionary)
    prints = {
        size: [bits for bits in _clear_prints(grey, squares_px, size, 1) if bits.tobytes() not in own]
        for size in _CELLS
    }
    patterns = sum(map(_patterns, prints.values()))
    turned = [np.ascontiguousarray(bits.T) for bits in prints[_size(dictionary)]]
    yield _Explanation.of(MIRRORED, dictionary, turned, own, patterns)
    for size in _CELLS:
        for family in _families(size):
            yield _Explanation.of(_FOREIGN, family, prints[size], _words(family), patterns)
    wide = _clear_prints(grey, squares_px, _size(dictionary), 2)
    yield _Explanation.of(_WIDE, dictionary, wide, own, _patterns(wide))


def _patterns(prints: Sequence[Bits]) -> int:
    """Return the number of different patterns: one square can be found twice."""
    return len({min(np.rot90(bits, turn).tobytes() for turn in range(4)) for bits in prints})


def _clear_prints(grey: Grey, squares_px: Array, size: int, border: int) -> list[Bits]:
    """Return the inner cells (size, size), 1 for white, of squares with clear cells and a black border."""
    if not len(squares_px):
        return []
    levels = read_cells(grey, squares_px, size + 2 * border)
    low, high = levels.min(axis=1, keepdims=True), levels.max(axis=1, keepdims=True)
    white = levels > (low + high) / 2
    off = np.minimum(levels - low, high - levels) / np.maximum(high - low, 1.0)
    cells = white.reshape(len(white), size + 2 * border, -1)
    inner = cells[:, border:-border, border:-border]
    black_border = white.sum(axis=1) == inner.sum(axis=(1, 2))
    clear = (off.max(axis=1) < _CLEAR) & (high - low > _CONTRAST)[:, 0] & black_border
    return [np.ascontiguousarray(cells, dtype=np.uint8) for cells in inner[clear]]


def _advice(kind: str, name: str, ids: Sequence[int], dictionary: str) -> str:
    if kind == MIRRORED:
        return (
            f"the image is mirrored: its prints fit the mirror images of {dictionary}; switch off the "
            "mirroring (flip) of the camera or its driver, and record again"
        )
    if kind == _NEGATIVE:
        return (
            f"the prints are negatives of {dictionary}, white on black: print the markers again, black on "
            "white (ipsys markers)"
        )
    if kind == _WIDE:
        return (
            f"the prints of {dictionary} have a black border of two cells: print the markers again, with a "
            "border of one cell (ipsys markers)"
        )
    stem, _, size = name.rpartition("_")
    if size == str(_SIZES[-1]):
        name = f"{stem}_{next(n for n in _SIZES if n > max(ids))}"
    return f'the prints are of {name}, not of {dictionary}: write dictionary = "{name}" into lab.toml'


@cache
def _known(dictionary: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))


def _size(dictionary: str) -> int:
    return int(_known(dictionary).markerSize)


@cache
def _families(size: int) -> tuple[str, ...]:
    return tuple(name for name in _FAMILIES if hasattr(cv2.aruco, name) and _size(name) == size)


@cache
def _words(dictionary: str) -> dict[bytes, int]:
    """Return the ids by the bytes of their cells, in all four turns."""
    codes, count = np.asarray(_known(dictionary).bytesList, dtype=np.uint8), _size(dictionary) ** 2
    # All bytes of a turn stand before those of the next one.
    bits = np.unpackbits(codes.reshape(len(codes), -1)[:, : codes.shape[1]], axis=1)
    # The last byte has the last cells in its low bits.
    bits = np.delete(bits, np.s_[count - count % 8 : bits.shape[1] - count % 8], axis=1)
    squares = bits.reshape(-1, _size(dictionary), _size(dictionary))
    turns = [np.ascontiguousarray(np.rot90(squares, turn, axes=(1, 2))) for turn in range(4)]
    words: dict[bytes, int] = {}
    for n, same in enumerate(zip(*turns, strict=True)):
        for cells in same:
            words.setdefault(cells.tobytes(), n)
    return words
