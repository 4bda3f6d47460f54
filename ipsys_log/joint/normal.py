"""Normal equations with a banded part: unknowns of single places are eliminated (Schur complement).

The local unknowns are poses of stationary bodies and knots of paths. A factor reaches only a few consecutive
ones, so that their matrix is banded. The global unknowns are those of cameras, bodies and the floor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky_banded, lapack
from scipy.sparse import csr_array

__all__ = ["Factorisation", "NormalEquations"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class NormalEquations:
    """Sums of J'J and J'r over factors, for ``local_count`` local and ``global_count`` global unknowns.

    ``band`` (bandwidth + 1, l) has the lower diagonals of the local part, as LAPACK wants them. ``mixed``
    (l, g) and ``dense`` (g, g) are the other parts, ``local_gradient`` (l,) and ``global_gradient`` (g,) the
    gradients.
    """

    def __init__(self, local_count: int, global_count: int, bandwidth: int) -> None:
        self.cost = 0.0
        self.band = np.zeros((bandwidth + 1, local_count))
        self.mixed = np.zeros((local_count, global_count))
        self.dense = np.zeros((global_count, global_count))
        self.local_gradient = np.zeros(local_count)
        self.global_gradient = np.zeros(global_count)

    def add_local(self, starts: Indices, slopes: Array, residuals: Array) -> None:
        """Add factors of k consecutive local unknowns each.

        Parameters
        ----------
        starts : (n,), the first local unknown of each factor.
        slopes : (n, r, k), derivatives of the weighted residuals.
        residuals : (n, r), weighted residuals.
        """
        across = slopes.swapaxes(1, 2)
        size = slopes.shape[2]
        rows, columns = np.tril_indices(size)
        count = self.band.shape[1]
        places = (rows - columns) * count + columns + starts[:, None]
        sums = np.bincount(
            places.ravel(), (across @ slopes)[:, rows, columns].ravel(), minlength=self.band.size
        )
        self.band += sums.reshape(self.band.shape)
        gradients = (across @ residuals[:, :, None])[:, :, 0]
        self.local_gradient += np.bincount(
            (starts[:, None] + np.arange(size)).ravel(), gradients.ravel(), minlength=count
        )

    def add_mixed(self, starts: Indices, slopes: Array, columns: Indices | slice, by_global: Array) -> None:
        """Add products of local and global derivatives.

        Parameters
        ----------
        starts, slopes : as for :meth:`add_local`.
        columns : the global unknowns, (u,).
        by_global : (n, r, u), derivatives of the weighted residuals.
        """
        count, rows, size = slopes.shape
        if not count:
            return
        first = int(starts.min())
        indices = np.repeat(starts - first, rows)[:, None] + np.arange(size)
        reach = int(starts.max()) - first + size
        ends = np.arange(count * rows + 1) * size
        sparse = csr_array((slopes.ravel(), indices.ravel(), ends), shape=(count * rows, reach))
        self.mixed[first : first + reach, columns] += sparse.T @ by_global.reshape(count * rows, -1)

    def add_global(self, columns: Indices, slopes: Array, residuals: Array) -> None:
        """Add factors of global unknowns: slopes (n, r, u) by the unknowns ``columns`` (u,)."""
        flat = slopes.reshape(-1, slopes.shape[2])
        self.dense[np.ix_(columns, columns)] += flat.T @ flat
        self.global_gradient[columns] += residuals.ravel() @ flat

    def add_global_block(self, rows: Indices, columns: Indices, block: Array) -> None:
        """Add a block (rows, columns) above or below the diagonal, and its transpose on the other side."""
        self.dense[np.ix_(rows, columns)] += block
        self.dense[np.ix_(columns, rows)] += block.T


class Factorisation:
    """Cholesky factors of damped normal equations.

    Parameters
    ----------
    normal : the normal equations.
    free : (g,), mask of the global unknowns that are estimated; the others stay constant.
    damping : factor on the diagonal, less one.

    Raises
    ------
    numpy.linalg.LinAlgError
        The equations do not determine the unknowns.
    """

    def __init__(self, normal: NormalEquations, free: NDArray[np.bool_], damping: float = 0.0) -> None:
        self.free = free
        self.local_count = len(normal.mixed)
        mixed = np.asfortranarray(normal.mixed[:, free])
        if self.local_count:
            band = normal.band.copy()
            band[0] *= 1 + damping
            self.band = cholesky_banded(band, lower=True, check_finite=False)
            # The columns of mixed, divided by the Cholesky factor.
            self.whitened = self.forward(mixed)
        else:
            self.band, self.whitened = normal.band, mixed
        dense = normal.dense[np.ix_(free, free)]
        reduced = dense - self.whitened.T @ self.whitened
        reduced[np.diag_indices_from(reduced)] *= 1 + damping
        # A diagonal of 1 avoids that the units of the unknowns decide on the rank.
        self.units = 1 / np.sqrt(np.maximum(dense.diagonal(), np.finfo(np.float64).tiny))
        self.reduced = cho_factor(reduced * self.units[:, None] * self.units, lower=True, check_finite=False)

    def step(self, normal: NormalEquations) -> tuple[Array, Array]:
        """Return the step of the global (g,) and the local unknowns (l,) that minimises the quadratic."""
        by_global = np.zeros(len(self.free))
        if not self.local_count:
            by_global[self.free] = -self.solve_reduced(normal.global_gradient[self.free])
            return by_global, np.zeros(0)
        pulled = self.forward(normal.local_gradient[:, None])
        gradient = normal.global_gradient[self.free] - self.whitened.T @ pulled[:, 0]
        by_global[self.free] = -self.solve_reduced(gradient)
        right = -(pulled[:, 0] + self.whitened @ by_global[self.free])
        return by_global, self._backward(right[:, None])[:, 0]

    def global_covariance(self) -> Array:
        """Return the covariance (g, g) of the global unknowns; zero for constant ones."""
        inverse = cho_solve(self.reduced, np.eye(len(self.units)), check_finite=False)
        covariance = np.zeros((len(self.free),) * 2)
        inverse = (inverse + inverse.T) / 2 * self.units[:, None] * self.units
        covariance[np.ix_(self.free, self.free)] = inverse
        return covariance

    def local_from_global(self, start: int, size: int) -> tuple[Array, Array]:
        """Return how a few local unknowns follow the global ones, and their own covariance.

        Returns
        -------
        slopes : (size, g), the change of the local unknowns by a change of the global ones.
        covariance : (size, size), for constant global unknowns.
        """
        unit = np.zeros((self.local_count, size))
        unit[start + np.arange(size), np.arange(size)] = 1.0
        own = self.forward(unit)
        slopes = np.zeros((size, len(self.free)))
        slopes[:, self.free] = -own.T @ self.whitened
        return slopes, np.asarray(own.T @ own)

    def solve_reduced(self, right: Array) -> Array:
        """Solve for the free global unknowns (f,) or (f, k), after the elimination of the local ones."""
        units = self.units if right.ndim == 1 else self.units[:, None]
        return np.asarray(cho_solve(self.reduced, right * units, check_finite=False) * units)

    def forward(self, right: Array) -> Array:
        """Divide columns (l, k) by the Cholesky factor of the local unknowns."""
        if not right.shape[1]:
            # LAPACK crashes without a column: all global unknowns are constant.
            return right
        return np.asarray(lapack.dtbtrs(self.band, right, uplo="L")[0])

    def _backward(self, right: Array) -> Array:
        return np.asarray(lapack.dtbtrs(self.band, right, uplo="L", trans="T")[0])
