"""Normal equations with a banded part: unknowns of single places are eliminated (Schur complement).

The local unknowns are poses of stationary bodies and knots of paths. A factor reaches only a few consecutive
ones, so that their matrix is banded. The global unknowns are those of cameras, bodies and the floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky_banded, lapack
from scipy.sparse import csr_array

from ipsys_log.messages import Array, Indices


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive local unknowns without a common factor with others, and the global ones of their factors.

    ``start`` and ``stop`` limit the local unknowns; ``columns`` (u,) are the global ones, in order.
    """

    start: int
    stop: int
    columns: Indices

    @property
    def rows(self) -> slice:
        """The local unknowns."""
        return slice(self.start, self.stop)


class NormalEquations:
    """Sums of J'J and J'r over factors, for ``local_count`` local and ``global_count`` global unknowns.

    ``band`` (bandwidth + 1, l) has the lower diagonals of the local part, as LAPACK wants them. ``coupling``
    has the part between local and global unknowns of each block, all zero elsewhere. ``dense`` (g, g) is the
    global part, ``local_gradient`` (l,) and ``global_gradient`` (g,) are the gradients. Without ``blocks``,
    one block has all unknowns.
    """

    def __init__(
        self, local_count: int, global_count: int, bandwidth: int, blocks: tuple[Block, ...] = ()
    ) -> None:
        self.cost = 0.0
        self.band = np.zeros((bandwidth + 1, local_count))
        self.blocks = blocks or (Block(0, local_count, np.arange(global_count)),)
        self.coupling = [np.zeros((one.stop - one.start, len(one.columns))) for one in self.blocks]
        self.dense = np.zeros((global_count, global_count))
        self.local_gradient = np.zeros(local_count)
        self.global_gradient = np.zeros(global_count)

    @property
    def mixed(self) -> Array:
        """The part between all local and all global unknowns, (l, g)."""
        if len(self.blocks) == 1:
            return self.coupling[0]
        mixed = np.zeros((self.band.shape[1], len(self.dense)))
        for block, own in zip(self.blocks, self.coupling, strict=True):
            mixed[block.rows, block.columns] = own
        return mixed

    def expect(self, by_global: Array, by_local: Array) -> float:
        """Return the decrease of twice the cost that the equations expect of a step."""
        return -float(by_global @ self.global_gradient + by_local @ self.local_gradient)

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
        if not len(starts):
            return
        if len(self.blocks) == 1:
            first, product = _multiply(starts, slopes, by_global)
            self.coupling[0][first : first + len(product), columns] += product
            return
        wanted = np.arange(len(self.dense))[columns]
        firsts = [block.start for block in self.blocks]
        numbers = np.searchsorted(firsts, starts, side="right") - 1
        for number in np.unique(numbers).tolist():
            block, rows = self.blocks[number], numbers == number
            places = np.searchsorted(block.columns, wanted)
            places = np.minimum(places, len(block.columns) - 1)
            inside = block.columns[places] == wanted
            first, product = _multiply(starts[rows], slopes[rows], by_global[rows][:, :, inside])
            own = self.coupling[number][first - block.start :][: len(product)]
            own[:, _as_slice(places[inside])] += product

    def add_global(self, columns: Indices, slopes: Array, residuals: Array) -> None:
        """Add factors of global unknowns: slopes (n, r, u) by the unknowns ``columns`` (u,)."""
        flat = slopes.reshape(-1, slopes.shape[2])
        self.dense[np.ix_(columns, columns)] += flat.T @ flat
        self.global_gradient[columns] += residuals.ravel() @ flat

    def add_global_block(self, rows: Indices, columns: Indices, block: Array) -> None:
        """Add a block (rows, columns) above or below the diagonal, and its transpose on the other side."""
        self.dense[np.ix_(rows, columns)] += block
        self.dense[np.ix_(columns, rows)] += block.T


def _as_slice(columns: Indices) -> Indices | slice:
    """Return columns as a slice if they are consecutive: NumPy then adds without copies."""
    if len(columns) and columns[-1] - columns[0] == len(columns) - 1:
        return slice(int(columns[0]), int(columns[-1]) + 1)
    return columns


def _multiply(starts: Indices, slopes: Array, by_global: Array) -> tuple[int, Array]:
    """Return the first local unknown of factors, and their products with global derivatives (l, u)."""
    count, rows, size = slopes.shape
    first = int(starts.min())
    indices = np.repeat(starts - first, rows)[:, None] + np.arange(size)
    reach = int(starts.max()) - first + size
    ends = np.arange(count * rows + 1) * size
    sparse = csr_array((slopes.ravel(), indices.ravel(), ends), shape=(count * rows, reach))
    return first, np.asarray(sparse.T @ by_global.reshape(count * rows, -1))


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
        self.local_count = normal.band.shape[1]
        self.band = normal.band
        if self.local_count:
            band = normal.band.copy()
            band[0] *= 1 + damping
            self.band = cholesky_banded(band, lower=True, check_finite=False)
        numbers = np.cumsum(free) - 1
        own_free = [free[block.columns] for block in normal.blocks]
        # The blocks with their columns among the free global unknowns.
        self.blocks = [
            replace(block, columns=numbers[block.columns[own]])
            for block, own in zip(normal.blocks, own_free, strict=True)
        ]
        # The coupling of each block, divided by the Cholesky factor.
        self.whitened = [
            self._whiten(block, np.asfortranarray(coupling[:, own]))
            for block, coupling, own in zip(self.blocks, normal.coupling, own_free, strict=True)
        ]
        dense = normal.dense[np.ix_(free, free)]
        reduced = self._reduce(dense)
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
        gradient = normal.global_gradient[self.free] - self.pull(pulled[:, 0])
        by_global[self.free] = -self.solve_reduced(gradient)
        right = -(pulled[:, 0] + self._push(by_global[self.free]))
        return by_global, self._backward(right[:, None])[:, 0]

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of the equations of all free unknowns."""
        parts = np.log(self.band[0]), np.log(self.reduced[0].diagonal()), -np.log(self.units)
        return 2 * float(sum(part.sum() for part in parts))

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
        slopes[:, self.free] = -self._pull_rows(own)
        return slopes, np.asarray(own.T @ own)

    def whiten(self, coupling: list[Array]) -> tuple[list[Array], Array]:
        """Divide columns (l, k) by the Cholesky factor of the local unknowns, block by block.

        Parameters
        ----------
        coupling : the rows of each block, (b, k), or (b, 0) for a block in which all columns are zero.

        Returns
        -------
        The whitened rows of each block, and the effect of all of them on the free global unknowns (f, k).
        """
        whitened = [
            self._whiten(block, np.asfortranarray(own))
            for block, own in zip(self.blocks, coupling, strict=True)
        ]
        total = np.zeros((len(self.units), max(own.shape[1] for own in coupling)))
        for block, ours, own in zip(self.blocks, self.whitened, whitened, strict=True):
            if own.shape[1]:
                total[block.columns] += ours.T @ own
        return whitened, total

    def pull(self, right: Array) -> Array:
        """Return the effect of whitened local values (l,) or (l, k) on the free global unknowns (f, ...)."""
        if len(self.blocks) == 1:
            return np.asarray(self.whitened[0].T @ right)
        total = np.zeros((len(self.units), *right.shape[1:]))
        for block, whitened in zip(self.blocks, self.whitened, strict=True):
            total[block.columns] += whitened.T @ right[block.rows]
        return total

    def _pull_rows(self, right: Array) -> Array:
        """Return the effects of whitened local values (l, k) as rows, (k, f)."""
        if len(self.blocks) == 1:
            return np.asarray(right.T @ self.whitened[0])
        return self.pull(right).T

    def _push(self, by_global: Array) -> Array:
        """Return the whitened local values (l,) that follow the free global unknowns (f,)."""
        parts = [
            whitened @ by_global[block.columns]
            for block, whitened in zip(self.blocks, self.whitened, strict=True)
        ]
        return np.concatenate(parts)

    def _reduce(self, dense: Array) -> Array:
        """Return the equations (f, f) of the global unknowns after the elimination of the local ones."""
        if len(self.blocks) == 1:
            return np.asarray(dense - self.whitened[0].T @ self.whitened[0])
        reduced = dense.copy()
        for block, whitened in zip(self.blocks, self.whitened, strict=True):
            reduced[np.ix_(block.columns, block.columns)] -= whitened.T @ whitened
        return reduced

    def _whiten(self, block: Block, coupling: Array) -> Array:
        """Divide the coupling of a block by its Cholesky factor."""
        if not coupling.size:
            # LAPACK crashes without a column: all global unknowns are constant.
            return coupling
        return np.asarray(lapack.dtbtrs(self.band[:, block.rows], coupling, uplo="L")[0])

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
