"""Errors of the calibration as a few modes: tables over the floor, one per camera.

The error of a position is a slow function of the place, the same in each frame. It is linear in independent
standard normal numbers, the amplitudes. Most of them are common to all cameras and places, so that the
products of sensitivities are the covariances of any two positions. The others are local: each camera has its
own, and a robot meets new ones after some distance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["LOCAL_M", "BiasModes", "Grid", "NodeModes", "reduce_modes"]

Array = NDArray[np.float64]

# A clock error counts like an error of 1 mm for each of these times.
_CLOCK_S = 0.001
# Local errors change over this distance: the correlation length of a floor. Tracks are alike with 0.3 to 1 m.
LOCAL_M = 0.5
# Numbers of one product of matrices (80 MB), and nodes whose distances are computed together.
_MOST_NUMBERS, _NODES_AT_ONCE = 10_000_000, 1000


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """The nodes of a grid over the floor: ``origin_m`` (2,), ``spacing_m``, and ``shape`` (nx, ny) >= 2."""

    origin_m: Array
    spacing_m: float
    shape: tuple[int, int]

    @property
    def points_m(self) -> Array:
        """The nodes (nx * ny, 2)."""
        axes = [
            start + self.spacing_m * np.arange(n) for start, n in zip(self.origin_m, self.shape, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class NodeModes:
    """The sensitivities of one camera at n nodes of a grid, before their reduction.

    Attributes
    ----------
    modes_m : (n, 3, c), errors by the amplitudes in ``columns``; NaN at a node that the camera cannot see.
    rest_m2 : (n, 3, 3), covariances of local errors.
    clock_s : (M,), error of the camera's clock by the amplitudes.
    rows : (n,), the nodes by their number in the grid; the camera cannot see the others. None: all nodes.
    columns : (c,), the amplitudes on which the errors depend. None: all M amplitudes.
    """

    modes_m: Array
    rest_m2: Array
    clock_s: Array
    rows: NDArray[np.intp] | None = None
    columns: NDArray[np.intp] | None = None

    def project(self, axes: Array) -> Array:
        """Return the errors (n, 3, k) by combinations (M, k) of the amplitudes."""
        product: Array = self.modes_m @ (axes if self.columns is None else axes[self.columns])
        return product


@dataclass(frozen=True, slots=True, eq=False)
class BiasModes:
    """Tables of the sensitivities of all cameras.

    Attributes
    ----------
    grid : the nodes; between them, the sensitivities are bilinear. Outside, they keep the value at the edge.
    tables : by camera, (nx, ny, 3, c) in m, by the amplitudes in ``columns``.
    clock_s : by camera, (m,), error of its clock.
    fade_m : (m,), distance after which a robot meets other amplitudes; infinite for the common ones.
    columns : by camera, (c,), the amplitudes on which its errors depend: the common ones, and its own.
    """

    grid: Grid
    tables: Mapping[str, Array]
    clock_s: Mapping[str, Array]
    fade_m: Array
    columns: Mapping[str, NDArray[np.intp]]

    @property
    def count(self) -> int:
        """The number m of amplitudes."""
        return len(self.fade_m)

    @classmethod
    def none(cls) -> BiasModes:
        """Return no modes: for models without a covariance."""
        return cls(Grid(np.zeros(2), 1.0, (2, 2)), {}, {}, np.zeros(0), {})

    def at(self, camera: str, points_m: Array, headings_rad: Array) -> Array:
        """Return the sensitivities of poses that a camera measured.

        Parameters
        ----------
        camera : its name; a camera without a table has no errors.
        points_m : (k, 2) or (k, 3).
        headings_rad : (k,).

        Returns
        -------
        (k, 4, m), of x, y, z in m and of the heading in rad.
        """
        count = len(points_m)
        if camera not in self.tables:
            return np.zeros((count, 4, self.count))
        cells, shares = self._cells(points_m)
        i, j = cells[:, 0], cells[:, 1]
        s, t = shares[:, 0, None, None], shares[:, 1, None, None]
        u, v = 1 - s, 1 - t
        row, corners = self.grid.shape[1], np.empty((4, count), dtype=np.intp)
        corners[0] = i * row + j
        corners[1], corners[2], corners[3] = corners[0] + row, corners[0] + 1, corners[0] + (row + 1)
        columns = self.columns[camera]
        near, right, above, far = self.tables[camera].reshape(-1, 3, len(columns)).take(corners, axis=0)
        own = np.empty((count, 4, len(columns)))
        own[:, :3] = (near * u + right * s) * v + (above * u + far * s) * t
        near, right, above, far = near[:, :2], right[:, :2], above[:, :2], far[:, :2]
        by_x = (right - near) * v + (far - above) * t
        by_y = (above - near) * u + (far - right) * s
        own[:, 3] = _turns(by_x, by_y, headings_rad) / self.grid.spacing_m
        sensitivities = np.zeros((count, 4, self.count))
        sensitivities[:, :, columns] = own
        return sensitivities

    def clock_of(self, camera: str) -> Array:
        """Return the error (m,) of a camera's clock by the amplitudes, in s."""
        return self.clock_s.get(camera, np.zeros(self.count))

    def _cells(self, points_m: Array) -> tuple[NDArray[np.intp], Array]:
        last = np.array(self.grid.shape) - 1
        places = (points_m[:, :2] - self.grid.origin_m) / self.grid.spacing_m
        places = np.minimum(np.maximum(places, 0), last)  # faster than np.clip
        cells = np.minimum(places.astype(np.intp), last - 1)
        return cells, places - cells


def _turns(by_x: Array, by_y: Array, headings_rad: Array) -> Array:
    """Return the turns (k, m) of headings by the slopes (k, 2, m) of the errors of positions."""
    cos, sin = np.cos(headings_rad)[:, None], np.sin(headings_rad)[:, None]
    along_x, along_y = by_x[:, 0] * cos + by_y[:, 0] * sin, by_x[:, 1] * cos + by_y[:, 1] * sin
    turns: Array = along_y * cos - along_x * sin
    return turns


def reduce_modes(grid: Grid, cameras: Mapping[str, NodeModes], count: int) -> BiasModes:
    """Return the tables with the ``count`` strongest combinations of the amplitudes of all cameras.

    The other combinations become local errors, so that the variance of each position is kept.
    """
    if not cameras:
        return BiasModes.none()
    # The right singular vectors, from the small matrix of all amplitudes: ascending order.
    _, axes = np.linalg.eigh(_products(cameras.values()))
    kept, others = axes[:, ::-1][:, :count], axes[:, ::-1][:, count:]
    size = kept.shape[1]
    total, tables, clock_s, columns = size + 3 * len(cameras), {}, {}, {}
    for number, (name, node) in enumerate(cameras.items()):
        left, modes_m = node.project(others), np.empty((len(node.modes_m), 3, size + 3))
        modes_m[:, :, :size] = node.project(kept)
        modes_m[:, :, size:] = _roots(node.rest_m2 + left @ left.swapaxes(1, 2))
        tables[name] = _fill(grid, modes_m, node.rows)
        clock_s[name] = np.append(node.clock_s @ kept, np.zeros(total - size))
        columns[name] = np.append(np.arange(size), size + 3 * number + np.arange(3))
    fade_m = np.where(np.arange(total) < size, np.inf, LOCAL_M)
    return BiasModes(grid, tables, clock_s, fade_m, columns)


def _products(nodes: Iterable[NodeModes]) -> Array:
    """Return the sums (M, M) of the products of the errors of all nodes by all amplitudes.

    The errors of a lab are one product of matrices. Those of a hall are several: they need too much memory.
    """
    products: Array | None = None
    waiting: list[Array] = []
    for number, node in enumerate(nodes := list(nodes)):
        waiting.append(_rows(node))
        if number + 1 == len(nodes) or sum(rows.size for rows in waiting) > _MOST_NUMBERS:
            together = np.concatenate(waiting)
            own = together.T @ together
            products, waiting = own if products is None else products + own, []
    assert products is not None
    return products


def _rows(node: NodeModes) -> Array:
    """Return the errors of all nodes as rows (r, M). All nodes have the same weight, and all cameras."""
    seen = np.isfinite(node.modes_m).all(axis=(1, 2))
    modes_m = node.modes_m[seen]
    sizes_m = np.sqrt((modes_m**2).sum(axis=(1, 2), keepdims=True))
    flat = (modes_m / np.maximum(sizes_m, 1e-12)).reshape(-1, modes_m.shape[2]) / np.sqrt(max(seen.sum(), 1))
    if node.columns is not None:
        own, flat = flat, np.zeros((len(flat), len(node.clock_s)))
        flat[:, node.columns] = own
    return np.concatenate([flat, node.clock_s[None] / _CLOCK_S])


def _roots(covariances: Array) -> Array:
    """Return the symmetric square roots of covariances (n, 3, 3); NaN stays NaN."""
    seen = np.isfinite(covariances).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(covariances[seen])
    roots = np.full_like(covariances, np.nan)
    roots[seen] = (axes * np.sqrt(np.maximum(variances, 0.0))[:, None]) @ axes.swapaxes(1, 2)
    return roots


def _fill(grid: Grid, own: Array, rows: NDArray[np.intp] | None) -> Array:
    """Return values of nodes as a table; a node without a value gets that of the nearest one with a value."""
    points_m = grid.points_m
    values = np.full((len(points_m), *own.shape[1:]), np.nan)
    values[slice(None) if rows is None else rows] = own
    seen = np.isfinite(values).all(axis=(1, 2))
    if seen.any():
        known_m, known = points_m[seen], values[seen]
        for some in np.array_split(np.flatnonzero(~seen), 1 + len(points_m) // _NODES_AT_ONCE):
            x_m, y_m = (points_m[some, None, axis] - known_m[:, axis] for axis in (0, 1))
            values[some] = known[(x_m**2 + y_m**2).argmin(axis=1)]
    else:
        values = np.zeros_like(values)
    return values.reshape(*grid.shape, *values.shape[1:])
