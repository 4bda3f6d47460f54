"""The mean error that remains after the stated error of the tape, with its confidence interval."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.messages import Array, ErrorStatistics

# Both ends of the 95 % confidence interval.
_LOW, _HIGH = 0.025, 0.975


def with_remaining_error(
    errors: ErrorStatistics, offsets_m: Array, tape_m2: Array, scale_m: Array, points: Sequence[str]
) -> ErrorStatistics:
    """Return error statistics with the mean error that remains after the error of the tape.

    A distance to a held-out tape point has the error of the model and that of the tape. Both are independent,
    because the point is not in the fit. So the mean square of the model's error is that of the distances,
    less that of the tape. Its interval follows from the sum of squares, which has about a chi2 distribution.
    The scale of the tape is an exception: model and tape share this error, and no distance shows it. It
    widens the interval only.

    Parameters
    ----------
    errors : of all distances.
    offsets_m : (repeats, n, d), predicted minus measured positions.
    tape_m2 : (n, d, d), covariances of the measured positions, without the scale of the tape.
    scale_m : (n,), standard deviations of the measured positions by the scale of the tape.
    points : (n,), names of the calibration points; cameras share the error of the tape at the same point.

    References
    ----------
    Satterthwaite, An approximate distribution of estimates of variance components, 1946.
    """
    # Late: most commands evaluate nothing. scipy.stats takes 0.3 s more.
    from scipy.special import gammaincinv

    tapes = np.trace(tape_m2, axis1=1, axis2=2)
    if not (tapes > 0).all():  # the sigma of the tape is not known
        return errors
    squares = (offsets_m**2).sum(axis=2)
    if not squares.any():
        return errors
    # A point where the tapes cross at a small angle tells little of a small error of the model.
    shares = 1 / (tapes + max(float((squares - tapes).mean()), 0.0))
    shares /= shares.sum()
    mean_m2, tape_mean_m2 = float((squares.mean(axis=0) * shares).sum()), float((tapes * shares).sum())
    remaining_m2 = max(mean_m2 - tape_mean_m2, 0.0)
    size = offsets_m.shape[2]
    spread_m2 = tape_m2 + remaining_m2 / size * np.eye(size)
    variances = 2 * (spread_m2**2).sum(axis=(1, 2))
    _, numbers = np.unique(np.array(points), return_inverse=True)
    # All squares of one point are taken for completely dependent.
    variance = float((np.bincount(numbers, shares * np.sqrt(variances)) ** 2).sum())
    expected_m2 = tape_mean_m2 + remaining_m2
    degrees = 2 * expected_m2**2 / variance
    # A quantile of chi-squared is twice that of the gamma distribution with half the degrees.
    low_m2, high_m2 = (
        mean_m2 * degrees / (2 * gammaincinv(degrees / 2, probability)) - tape_mean_m2
        for probability in (_HIGH, _LOW)
    )
    scale_m2 = (2 * gammaincinv(0.5, 0.95) * scale_m**2).mean()
    # The ratio of the mean to the root mean square is about that of all distances.
    ratio = errors.mean_m / np.sqrt(squares.mean())
    low_m, mean_m, high_m = (
        float(ratio * np.sqrt(max(value_m2, 0.0))) for value_m2 in (low_m2, remaining_m2, high_m2)
    )
    high_m = float(np.hypot(high_m, ratio * np.sqrt(scale_m2)))
    return replace(errors, remaining_m=mean_m, remaining_low_m=low_m, remaining_high_m=high_m)
