"""Scale of the tape: what the readings say of it, against what is known before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.arrays import Array
from ipsys_log.joint.floor_unevenness import most_likely_scale
from ipsys_log.joint.observations import Observations
from ipsys_log.joint.parameters import Layout, State, tape_sigmas

# Uncertainty of the standard deviations of both scales, as that of their logarithm: the readings decide.
_SPREAD = 3.0


def widen_tape(layout: Layout, state: State, covariance: Array) -> Layout:
    """Return the layout with larger standard deviations of the scales if the readings contradict them.

    The readings show that tape and reference points disagree, but not which of them is wrong. So both get the
    same factor, of at least 1: their covariance then covers the contradiction.

    Parameters
    ----------
    layout, state, covariance : of a fit; ``covariance`` (g, g) is that of the global unknowns.
    """
    columns = _free(layout)
    if not len(columns):
        return layout
    sigma = layout.sigma.copy()
    units = sigma[columns]
    pulls = (state.values - layout.mean)[columns] / units
    shares = covariance[np.ix_(columns, columns)] / units[:, None] / units
    # One contradiction determines a standard deviation poorly: its most likely factor is often too small. Its
    # square is a choice for the coverage of positions with a tape that is 0.3 % too long.
    sigma[columns] *= max(1.0, most_likely_scale(pulls, shares, _SPREAD)) ** 2
    return replace(layout, sigma=sigma)


def tape_contradiction(
    layout: Layout, state: State, covariance: Array, observations: Observations
) -> tuple[float, float]:
    """Return by how much the tape reads too long for the reference points, and this in standard deviations.

    The relative length is that of the readings alone, without what is known before. Its standard deviation
    has the errors of the readings, and those of both scales.
    """
    columns = _free(layout)
    if not len(columns):
        return 0.0, 0.0
    inverse = np.linalg.inv(covariance[np.ix_(columns, columns)])
    information = inverse - np.diag(1 / layout.sigma[columns] ** 2)
    pull = inverse @ (state.values - layout.mean)[columns]
    known = tape_sigmas(observations)[columns - layout.tape.start]
    by_scales = information.sum(axis=0)
    weight = float(by_scales.sum())
    variance = float(by_scales @ (known**2 * by_scales)) + weight
    total = float(pull.sum())
    return len(columns) * total / weight, total / float(np.sqrt(variance))


def _free(layout: Layout) -> NDArray[np.intp]:
    """Return the columns of the scales that the fit estimates."""
    columns = np.arange(layout.tape.start, layout.tape.stop)
    return columns[layout.sigma[columns] > 0]
