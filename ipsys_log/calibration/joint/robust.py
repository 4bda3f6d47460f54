"""Robust loss of the joint calibration: squares for normal errors, a logarithm for outliers."""

import numpy as np

from ipsys_log.messages import Array

# Up to this many standard deviations of chi2 above its mean, an error counts as normal.
_NORMAL_SPREAD = 4.5


def limit_of(degrees: Array | float) -> Array | float:
    """Return the largest chi2 of a normal error with so many degrees of freedom (about 99.9 %)."""
    return degrees + _NORMAL_SPREAD * np.sqrt(2 * degrees)


def robust_loss(chi2: Array, limit: Array | float) -> tuple[Array, Array]:
    """Return the loss of squared standardised errors, and the weight of each error.

    The loss is chi2 up to ``limit``, and grows with its logarithm above. The covariance of the estimate is
    then that of plain squares, as long as there is no outlier.

    Parameters
    ----------
    chi2 : (n,), squared standardised errors.
    limit : the largest chi2 of a normal error.

    Returns
    -------
    loss, weights : (n,), and the derivative of the loss (n,).

    Examples
    --------
    >>> loss, weights = robust_loss(np.array([4.0, 27.0]), 9.0)
    >>> loss.round(3).tolist(), weights.round(3).tolist()
    ([4.0, 18.888], [1.0, 0.333])
    """
    ratio = np.maximum(chi2 / limit, 1.0)
    return np.where(ratio > 1, limit * (1 + np.log(ratio)), chi2), 1 / ratio
