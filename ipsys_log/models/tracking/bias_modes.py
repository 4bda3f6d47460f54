"""Errors of the calibration as a few modes: tables over the floor, one per camera.

The error of a position is a slow function of the place, the same in each frame. It is linear in independent
standard normal numbers, the amplitudes. Most of them are common to all cameras and places, so that the
products of sensitivities are the covariances of any two positions. The others are local: each camera has its
own, and a robot meets new ones after some distance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array

# A clock error counts like an error of 1 mm for each of these times.
_CLOCK_S = 0.001
# Local errors change over this distance: the correlation length of a floor. Tracks are alike with 0.3 to 1 m.
LOCAL_M = 0.5
# Rays that are flatter than this (cosine with the vertical) do not belong to positions.
FLATTEST = 0.2
# Nodes whose distances are computed together.
_NODES_AT_ONCE = 1000


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


class CameraNodes(Protocol):
    """The sensitivities of one camera at n nodes of a grid, before their reduction."""

    @property
    def rest_m2(self) -> Array:
        """Covariances (n, 3, 3) of local errors."""

    @property
    def clock_s(self) -> Array:
        """The error (M,) of the camera's clock by the amplitudes."""

    @property
    def rows(self) -> NDArray[np.intp] | None:
        """The nodes (n,) by their number in the grid; the camera cannot see the others. None: all nodes."""

    @property
    def columns(self) -> NDArray[np.intp] | None:
        """The amplitudes (c,) on which the errors depend. None: all M amplitudes."""

    def errors(self) -> Array:
        """Return the errors (n, 3, c) by these amplitudes; NaN at a node that the camera cannot see."""

    def project(self, axes: Array) -> Array:
        """Return the errors (n, 3, k) by combinations (M, k) of the amplitudes."""


@dataclass(frozen=True, slots=True, eq=False)
class NodeModes:
    """Stored sensitivities of one camera; ``modes_m`` (n, 3, c) are the errors, see :class:`CameraNodes`."""

    modes_m: Array
    rest_m2: Array
    clock_s: Array
    rows: NDArray[np.intp] | None = None
    columns: NDArray[np.intp] | None = None

    def errors(self) -> Array:
        """Return the errors (n, 3, c) by the amplitudes in ``columns``."""
        return self.modes_m

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
    tables : by camera, (r, 3, c) in m, at the r nodes that it can see, by the amplitudes in ``columns``.
    rows : by camera, (nx * ny,), the row of its table for each node: its own, or that of the nearest node.
    clock_s : by camera, (m,), error of its clock.
    fade_m : (m,), distance after which a robot meets other amplitudes; infinite for the common ones.
    columns : by camera, (c,), the amplitudes on which its errors depend: the common ones, and its own.
    """

    grid: Grid
    tables: Mapping[str, Array]
    rows: Mapping[str, NDArray[np.intp]]
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
        return cls(Grid(np.zeros(2), 1.0, (2, 2)), {}, {}, {}, np.zeros(0), {})

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
        near, right, above, far = self.tables[camera].take(self.rows[camera].take(corners), axis=0)
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


def reduce_modes(grid: Grid, cameras: Mapping[str, CameraNodes], count: int) -> BiasModes:
    """Return the tables with the ``count`` strongest combinations of the amplitudes of all cameras.

    The other combinations become local errors, so that the variance of each position is kept.
    """
    if not cameras:
        return BiasModes.none()
    # The right singular vectors, from the small matrix of all amplitudes: ascending order.
    products, totals_m2 = _products(cameras.values())
    _, axes = np.linalg.eigh(products)
    kept = axes[:, ::-1][:, :count]
    size = kept.shape[1]
    total, tables, rows, clock_s, columns = size + 3 * len(cameras), {}, {}, {}, {}
    for number, (name, node) in enumerate(cameras.items()):
        strong_m = node.project(kept)
        # A product with the hundreds of other combinations would take most of the time in a hall.
        others_m2 = totals_m2[number] - _squares(strong_m)
        modes_m = np.concatenate([strong_m, _roots(node.rest_m2 + others_m2)], axis=2)
        tables[name], rows[name] = _tabulate(grid, modes_m, node.rows)
        clock_s[name] = np.append(node.clock_s @ kept, np.zeros(total - size))
        columns[name] = np.append(np.arange(size), size + 3 * number + np.arange(3))
    fade_m = np.where(np.arange(total) < size, np.inf, LOCAL_M)
    return BiasModes(grid, tables, rows, clock_s, fade_m, columns)


def _squares(modes_m: Array) -> Array:
    """Return the covariances (n, 3, 3) of modes (n, 3, c)."""
    product: Array = modes_m @ modes_m.swapaxes(1, 2)
    return product


def _products(nodes: Iterable[CameraNodes]) -> tuple[Array, list[Array]]:
    """Return the sums (M, M) of the products of the errors of all nodes by all amplitudes.

    The second part are the covariances (n, 3, 3) of these errors at the nodes of each camera.
    """
    products: Array = np.zeros(())
    totals_m2 = []
    for node in nodes:
        # One camera after the other: the errors of all nodes of a hall need too much memory.
        errors, clock = node.errors(), node.clock_s / _CLOCK_S
        totals_m2.append(_squares(errors))
        products = products + np.outer(clock, clock)
        rows = _rows(errors)
        columns = np.arange(len(clock)) if node.columns is None else node.columns
        products[np.ix_(columns, columns)] += rows.T @ rows
    return products, totals_m2


def _rows(errors: Array) -> Array:
    """Return errors (n, 3, c) as rows (r, c). All nodes have the same weight, and all cameras."""
    seen = np.isfinite(errors).all(axis=(1, 2))
    rows = errors[seen].reshape(-1, errors.shape[2])
    sizes_m = np.sqrt(np.einsum("rc,rc->r", rows, rows).reshape(-1, 3).sum(axis=1))
    rows *= np.repeat(1 / np.maximum(sizes_m, 1e-12), 3)[:, None] / np.sqrt(max(seen.sum(), 1))
    return rows


def _roots(covariances: Array) -> Array:
    """Return the symmetric square roots of covariances (n, 3, 3); NaN stays NaN."""
    seen = np.isfinite(covariances).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(covariances[seen])
    roots = np.full_like(covariances, np.nan)
    roots[seen] = (axes * np.sqrt(np.maximum(variances, 0.0))[:, None]) @ axes.swapaxes(1, 2)
    return roots


def _tabulate(grid: Grid, values: Array, rows: NDArray[np.intp] | None) -> tuple[Array, NDArray[np.intp]]:
    """Return the finite values (r, 3, c) of nodes, and for each node of the grid the row of the nearest one.

    Without finite values, all are 0.
    """
    seen = np.isfinite(values).all(axis=(1, 2))
    known = np.flatnonzero(seen) if rows is None else rows[seen]
    count = grid.shape[0] * grid.shape[1]
    if not len(known):
        return np.zeros((1, *values.shape[1:])), np.zeros(count, dtype=np.intp)
    row_of = np.full(count, -1)
    row_of[known] = np.arange(len(known))
    unseen = np.flatnonzero(row_of < 0)
    if len(unseen):
        row_of[unseen] = row_of[_nearest(grid.points_m, unseen, _edge(row_of.reshape(grid.shape) >= 0))]
    return values[seen], row_of


def _nearest(points_m: Array, nodes: NDArray[np.intp], others: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the nearest one of ``others`` for each of ``nodes``."""
    others_m = points_m[others]
    nearest = []
    for some in np.array_split(nodes, 1 + len(nodes) // _NODES_AT_ONCE):
        x_m, y_m = (points_m[some, None, axis] - others_m[:, axis] for axis in (0, 1))
        nearest.append(others[(x_m**2 + y_m**2).argmin(axis=1)])
    return np.concatenate(nearest)


def _edge(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the nodes in a mask (nx, ny) beside a node outside: only they are the nearest ones of others."""
    padded = np.pad(seen, 1, constant_values=True)
    inner = padded[2:, 1:-1] & padded[:-2, 1:-1] & padded[1:-1, 2:] & padded[1:-1, :-2]
    return np.flatnonzero(seen & ~inner)
