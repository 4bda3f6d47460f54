"""The data for an evaluation: measurements, their observations, and the split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.tape import RiggedMeasurement
from ipsys_log.messages import Pair


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The data for an evaluation.

    Attributes
    ----------
    places : the measurements that count.
    pairs : pairs of all measurements that a camera saw, by camera.
    held_out : ids of the held-out measurements.
    subsets : ids by the label of a published subset for fitting.
    truth : ground-truth world points (3,) in m by id; empty outside a simulated lab.
    seed : of folds and random subsets; None for a model of another log, which is not fitted again.
    """

    places: Sequence[RiggedMeasurement]
    pairs: Mapping[str, Sequence[Pair]]
    held_out: set[str]
    subsets: Mapping[str, set[str]]
    truth: Mapping[str, NDArray[np.float64]]
    seed: int | None
