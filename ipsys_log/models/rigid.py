"""Rigid transformation from camera coordinates to world coordinates (sect. 2.2.1 of the paper)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.messages.arrays import Array


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


class RigidTransform(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A scikit-learn regressor from (n, 3) to (n, 3), in m, by :func:`rigid_transform`.

    Attributes
    ----------
    rotation_ : (3, 3)
    translation_ : (3,)
    """

    fitted: ClassVar[tuple[str, ...]] = ("rotation_", "translation_")

    def fit(self, X: Any, y: Any) -> RigidTransform:
        X, y = validate_data(self, X, y, multi_output=True, dtype=np.float64)
        if X.shape[1] != 3 or y.shape != X.shape:
            raise FitError(f"rigid maps (n, 3) to (n, 3), found {X.shape} and {y.shape}")
        self.rotation_, self.translation_ = rigid_transform(X, y)
        return self

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(np.asarray(X, dtype=np.float64))

    def predict_array(self, X: Array) -> Array:
        prediction: Array = X @ self.rotation_.T + self.translation_  # eq. (6)
        return prediction

    transform = predict  # the first step of a hybrid
