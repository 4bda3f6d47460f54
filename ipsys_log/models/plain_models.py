"""The models in closed form as plain functions and parameters, without scikit-learn: its import takes 0.6 s.

References
----------
Ou et al., Robotica 2023, sect. 2.2.1 and 2.2.2: rigid transformation and polynomial regression.
"""

from functools import cache
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FitError
from ipsys_log.messages import Array


def rigid_transform(points: Array, targets: Array) -> tuple[Array, Array]:
    """Return the rotation and translation that map ``points`` to ``targets`` with least squares.

    Parameters
    ----------
    points, targets : (n, 3), pairs of points, in m.

    Returns
    -------
    rotation : (3, 3), proper (determinant +1).
    translation : (3,), in m. ``targets`` is about ``points @ rotation.T + translation``.

    Raises
    ------
    FitError
        There are fewer than three pairs, or the pairs are on a line: the rotation about the line is not
        determined.

    References
    ----------
    Ou et al., Robotica 2023, eq. (6) to (12). Eq. (11) can give a reflection if the points are nearly in a
    plane. The smallest singular direction is then reversed (Umeyama, PAMI 1991).

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> rotation, translation = rigid_transform(points, points + [0, 0, 2])
    >>> translation.round(9).tolist()
    [0.0, 0.0, 2.0]
    """
    if len(points) < 3:
        raise FitError(f"rigid needs at least 3 pairs, found {len(points)}; measure more points")
    mean_x, mean_y = points.mean(axis=0), targets.mean(axis=0)  # eq. (8)
    u, s, vt = np.linalg.svd((points - mean_x).T @ (targets - mean_y))  # eq. (9), (10)
    if s[1] <= 1e-9 * s[0]:
        raise FitError("rigid needs pairs that are not all on one line; measure points beside the line")
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation: Array = vt.T @ flip @ u.T  # eq. (11)
    return rotation, mean_y - rotation @ mean_x  # eq. (12)


class Rigid:
    """A rigid transformation from (n, 3) to (n, 3), in m.

    Attributes
    ----------
    rotation_ : (3, 3)
    translation_ : (3,)
    """

    fitted: ClassVar[tuple[str, ...]] = ("rotation_", "translation_")
    rotation_: Array
    translation_: Array

    def fit_array(self, X: Array, y: Array) -> Self:
        """Fit by :func:`rigid_transform`."""
        self.rotation_, self.translation_ = rigid_transform(X, y)
        return self

    def predict_array(self, X: Array) -> Array:
        prediction: Array = X @ self.rotation_.T + self.translation_  # eq. (6)
        return prediction


def regressors(points: Array) -> Array:
    """Return constant, linear and second-order terms of each row: ten terms for three columns.

    Parameters
    ----------
    points : (n, d)

    Returns
    -------
    (n, 1 + d + d (d + 1) / 2): 1, x, y, z, xx, xy, xz, yy, yz, zz for d = 3.

    References
    ----------
    Ou et al., Robotica 2023, below eq. (13).

    Examples
    --------
    >>> regressors(np.array([[2.0, 3.0, 5.0]]))[0].tolist()
    [1.0, 2.0, 3.0, 5.0, 4.0, 6.0, 10.0, 9.0, 15.0, 25.0]
    """
    first, second = _factors(points.shape[1])
    count, columns = points.shape
    terms: Array = np.ones((count, 1 + columns + len(first)))
    terms[:, 1 : 1 + columns] = points
    np.multiply(points[:, first], points[:, second], out=terms[:, 1 + columns :])
    return terms


@cache
def _factors(columns: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the columns of both factors of the second-order terms."""
    first, second = np.triu_indices(columns)
    return first, second


class Polynomial:
    """A polynomial of second order (eq. 13).

    Attributes
    ----------
    centre_, scale_ : (d,), mean and largest absolute deviation of the inputs.
    coefficients_ : (terms, outputs), for the centred and scaled inputs.
    """

    fitted: ClassVar[tuple[str, ...]] = ("centre_", "scale_", "coefficients_")
    centre_: Array
    scale_: Array
    coefficients_: Array

    def fit_array(self, X: Array, y: Array) -> Self:
        """Fit by ordinary least squares (eq. 14) to inputs (n, d) and targets (n, outputs).

        The fit centres and scales the inputs, and solves the problem by singular values, not by the normal
        equations of eq. (14). The fitted function is the same, but the precision is better, because Zc^2 is
        nearly constant on a floor.
        """
        self.centre_ = X.mean(axis=0)
        spread = np.abs(X - self.centre_).max(axis=0)
        self.scale_ = np.where(spread > 0, spread, 1.0)
        terms = regressors((X - self.centre_) / self.scale_)
        self.coefficients_ = np.asarray(np.linalg.lstsq(terms, y, rcond=None)[0], dtype=np.float64)
        return self

    def predict_array(self, X: Array) -> Array:
        prediction: Array = regressors((X - self.centre_) / self.scale_) @ self.coefficients_
        return prediction
