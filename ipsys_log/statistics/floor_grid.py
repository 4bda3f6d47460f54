"""A grid over the floor: its points, and the connected parts of a mask."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ipsys_log.messages.arrays import Array, Mask

# Step of the grid, and its least distance from the walls.
GRID_M = 0.1
WALL_M = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """A grid over the floor: coordinates ``xs_m`` (a,) and ``ys_m`` (b,) of its nodes, ``step_m`` apart."""

    xs_m: Array
    ys_m: Array
    step_m: float

    @classmethod
    def over(cls, low_m: Array, high_m: Array, step_m: float = GRID_M) -> FloorGrid:
        """Return the grid over a rectangle, at least 0.3 m from its edges."""
        # The small number keeps a node that is exactly at the limit.
        axes = [
            np.arange(low + WALL_M, high - WALL_M + 1e-6, step_m)
            for low, high in zip(low_m, high_m, strict=True)
        ]
        return cls(axes[0], axes[1], step_m)

    @classmethod
    def of_cells(cls, low_m: Array, high_m: Array, step_m: float) -> FloorGrid:
        """Return the middles of the cells of a rectangle, the first one half a step from its corner."""
        axes = [np.arange(low + step_m / 2, high, step_m) for low, high in zip(low_m, high_m, strict=True)]
        return cls(axes[0], axes[1], step_m)

    @property
    def nodes_m(self) -> Array:
        """The nodes (b * a, 2), row by row."""
        return np.stack(np.meshgrid(self.xs_m, self.ys_m), axis=-1).reshape(-1, 2)

    def patches(self, mask: Mask, least_m2: float) -> list[GridPart]:
        """Return the connected parts of a mask (b, a), not smaller than an area; the largest first."""
        return sorted(self._patches(mask, least_m2), key=lambda patch: -patch.area_m2)

    def _patches(self, mask: Mask, least_m2: float) -> Iterator[GridPart]:
        from scipy.ndimage import find_objects, label  # late: it takes 1 s

        labels, _ = label(mask, np.ones((3, 3)))
        for number, (rows, columns) in enumerate(find_objects(labels), 1):
            area_m2 = float((labels[rows, columns] == number).sum()) * self.step_m**2
            if area_m2 >= least_m2:
                x_m, y_m = self.xs_m[columns], self.ys_m[rows]
                low_m, high_m = np.array([x_m[0], y_m[0]]), np.array([x_m[-1], y_m[-1]])
                yield GridPart(area_m2, low_m, high_m, labels == number)


@dataclass(frozen=True, slots=True, eq=False)
class GridPart:
    """A connected part of a grid: nodes from ``low_m`` to ``high_m`` (2,), and the mask ``inside`` (b, a)."""

    area_m2: float
    low_m: Array
    high_m: Array
    inside: Mask
