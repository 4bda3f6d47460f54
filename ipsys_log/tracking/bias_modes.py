"""Errors of the calibration as a few modes: tables over the floor, one per camera.

The error of a position is a slow function of the place, the same in each frame. It is linear in m independent
standard normal numbers, the amplitudes. They are common to all cameras and places, so that the products of
sensitivities are the covariances of any two positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["BiasModes", "Grid", "NodeModes", "reduce_modes"]

Array = NDArray[np.float64]

# A step of the clock counts like an error of a position at this speed.
_CLOCK_M_S = 1.0


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
    """The sensitivities of one camera at nodes, before their reduction.

    Attributes
    ----------
    modes_m : (n, 3, M), errors by all M amplitudes; NaN at a node that the camera cannot see.
    rest_m2 : (n, 3, 3), covariances of errors of the place alone: no two places share them.
    clock_s : (M,), error of the camera's clock by the amplitudes.
    """

    modes_m: Array
    rest_m2: Array
    clock_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class BiasModes:
    """Tables of the sensitivities of all cameras.

    Attributes
    ----------
    grid : the nodes; between them, the sensitivities are bilinear. Outside, they keep the value at the edge.
    tables : by camera, (nx, ny, 3, m) in m.
    rest_m2 : by camera, (nx, ny, 3, 3): the variance that is not in the m modes, and errors of the place.
    clock_s : by camera, (m,).
    count : the number m of amplitudes.
    """

    grid: Grid
    tables: Mapping[str, Array]
    rest_m2: Mapping[str, Array]
    clock_s: Mapping[str, Array]
    count: int

    @classmethod
    def none(cls) -> BiasModes:
        """Return no modes: for models without a covariance."""
        return cls(Grid(np.zeros(2), 1.0, (2, 2)), {}, {}, {}, 0)

    def at(self, camera: str, points_m: Array, headings_rad: Array) -> tuple[Array, Array]:
        """Return the sensitivities of poses that a camera measured.

        Parameters
        ----------
        camera : its name; a camera without a table has no errors.
        points_m : (k, 2) or (k, 3).
        headings_rad : (k,).

        Returns
        -------
        sensitivities : (k, 4, m), of x, y, z in m and of the heading in rad.
        rest_m2 : (k, 3, 3), covariances of the other errors.
        """
        count = len(points_m)
        if camera not in self.tables:
            return np.zeros((count, 4, self.count)), np.zeros((count, 3, 3))
        cells, shares = self._cells(points_m)
        i, j = cells[:, 0], cells[:, 1]
        s, t = shares[:, 0, None, None], shares[:, 1, None, None]
        table, rest = self.tables[camera], self.rest_m2[camera]
        near, right, above, far = table[i, j], table[i + 1, j], table[i, j + 1], table[i + 1, j + 1]
        sensitivities = np.empty((count, 4, self.count))
        sensitivities[:, :3] = (near * (1 - s) + right * s) * (1 - t) + (above * (1 - s) + far * s) * t
        by_x = (right - near) * (1 - t) + (far - above) * t
        by_y = (above - near) * (1 - s) + (far - right) * s
        sensitivities[:, 3] = _turns(by_x, by_y, headings_rad) / self.grid.spacing_m
        lower = rest[i, j] * (1 - s) + rest[i + 1, j] * s
        upper = rest[i, j + 1] * (1 - s) + rest[i + 1, j + 1] * s
        return sensitivities, lower * (1 - t) + upper * t

    def clock_of(self, camera: str) -> Array:
        """Return the error (m,) of a camera's clock by the amplitudes, in s."""
        return self.clock_s.get(camera, np.zeros(self.count))

    def _cells(self, points_m: Array) -> tuple[NDArray[np.intp], Array]:
        last = np.array(self.grid.shape) - 1
        places = np.clip((points_m[:, :2] - self.grid.origin_m) / self.grid.spacing_m, 0, last)
        cells = np.minimum(places.astype(np.intp), last - 1)
        return cells, places - cells


def _turns(by_x: Array, by_y: Array, headings_rad: Array) -> Array:
    """Return the turns (k, m) of headings by the slopes (k, 3, m) of the errors of positions."""
    cos, sin = np.cos(headings_rad)[:, None], np.sin(headings_rad)[:, None]
    along_x, along_y = by_x[:, 0] * cos + by_y[:, 0] * sin, by_x[:, 1] * cos + by_y[:, 1] * sin
    turns: Array = along_y * cos - along_x * sin
    return turns


def reduce_modes(grid: Grid, cameras: Mapping[str, NodeModes], count: int) -> BiasModes:
    """Return the tables with the ``count`` strongest combinations of the amplitudes of all cameras.

    The variance of the others is in ``rest_m2``, so that the total variance of a position is kept.
    """
    rows = [_rows(node) for node in cameras.values()]
    if not rows:
        return BiasModes.none()
    together = np.concatenate(rows)
    # The right singular vectors, from the small matrix of all amplitudes: ascending order.
    _, axes = np.linalg.eigh(together.T @ together)
    kept, others = axes[:, ::-1][:, :count], axes[:, ::-1][:, count:]
    tables, rest_m2 = {}, {}
    for name, node in cameras.items():
        left = node.modes_m @ others
        tables[name] = _fill(grid, node.modes_m @ kept)
        rest_m2[name] = _fill(grid, node.rest_m2 + left @ left.swapaxes(1, 2))
    clock_s = {name: node.clock_s @ kept for name, node in cameras.items()}
    return BiasModes(grid, tables, rest_m2, clock_s, kept.shape[1])


def _rows(node: NodeModes) -> Array:
    """Return the errors of all nodes as rows (r, M), each camera with the same weight."""
    seen = np.isfinite(node.modes_m).all(axis=(1, 2))
    flat = node.modes_m[seen].reshape(-1, node.modes_m.shape[2])
    rows: Array = np.concatenate([flat / np.sqrt(max(seen.sum(), 1)), _CLOCK_M_S * node.clock_s[None]])
    return rows


def _fill(grid: Grid, values: Array) -> Array:
    """Return values of nodes as a table; a node without a value gets that of the nearest one with a value."""
    points_m = grid.points_m
    seen = np.isfinite(values).all(axis=(1, 2))
    if seen.any():
        apart = ((points_m[~seen, None] - points_m[None, seen]) ** 2).sum(axis=2)
        values = values.copy()
        values[~seen] = values[seen][apart.argmin(axis=1)]
    else:
        values = np.zeros_like(values)
    return values.reshape(*grid.shape, *values.shape[1:])
