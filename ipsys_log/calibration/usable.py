"""Results that are too poor to use: pictures of two cameras, too few pictures, a wrong lens model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle_adjustment import Corners
from ipsys_log.calibration.lens_models import LENSES, LensModel
from ipsys_log.calibration.solve import rms_px, solve
from ipsys_log.calibration.two_cameras import TwoCameras

__all__ = ["MOST_RMS_PX", "BetterModel", "find_better_model", "two_cameras_fault"]

MOST_RMS_PX = 2.0
# Another model is better if its error is less than this share.
_BETTER, _AS_WELL = 0.6, 1.1


class BetterModel(NamedTuple):
    """The name of a lens model, and its RMS reprojection error in px."""

    name: str
    rms_px: float


def find_better_model(
    model: LensModel, corners: Corners, size_px: tuple[int, int], left_px: float
) -> BetterModel | None:
    """Return the model with the least error for the same corners, if it is far less than ``left_px``."""
    tried = []
    for name, other in LENSES.items():
        if other == model:
            continue
        try:
            solved = solve(other, corners, size_px)
        except np.linalg.LinAlgError:
            continue
        # A model that leaves out most pictures does not describe them.
        if 2 * len(solved.pictures) >= corners.pictures:
            tried.append(BetterModel(name, rms_px(solved)))
    least_px = min((one.rms_px for one in tried), default=np.inf)
    if least_px >= _BETTER * left_px:
        return None
    # The first of the equally good models: it has fewer coefficients that are hard to tell apart.
    return next(one for one in tried if one.rms_px <= _AS_WELL * least_px)


def two_cameras_fault(split: TwoCameras, names: Sequence[str]) -> str:
    """Return the fault text for pictures of two cameras, with the pictures of each."""
    groups = ", ".join(_named(names, split.second == second) for second in (False, True))
    return (
        f"the pictures are of two cameras, or of two settings of zoom or focus: {groups}; one set of "
        f"intrinsics leaves {split.one_px:.2f} px, two leave {split.two_px:.2f}"
    )


def _named(names: Sequence[str], group: NDArray[np.bool_]) -> str:
    return f"{group.sum()} of one ({', '.join(name for name, own in zip(names, group, strict=True) if own)})"
