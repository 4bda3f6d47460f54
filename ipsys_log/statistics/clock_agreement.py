"""Clocks of nodes against the joint calibration of the same log: two independent estimates of one offset.

The times of a node's frames are converted by its clock estimates, so the joint calibration should find no
clock offset. An offset beyond the bound of the estimates and its own uncertainty has one of two causes:
delays of the network that differ between both directions, or a latency of the camera that the rig does not
give.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ipsys_log.messages import ClockEstimate, Model
from ipsys_log.statistics.calibrated_cameras import CalibratedCamera, describe_cameras
from ipsys_log.units import NS_PER_S

_SIGMAS = 3.0
_MS_PER_S = 1000.0


@dataclass(frozen=True, slots=True)
class ClockContradiction:
    """A camera of a node whose two clock estimates contradict each other.

    Attributes
    ----------
    camera : its name.
    difference_s : time that the joint calibration adds to its stamps; the node's estimate leaves 0.
    sigma_s : standard deviation of the joint calibration.
    bound_s : mean bound of the node's estimates, plus that of the reference camera if it has a node too.
    """

    camera: str
    difference_s: float
    sigma_s: float
    bound_s: float

    @property
    def text(self) -> str:
        """The contradiction in one sentence."""
        difference_ms, sigma_ms, bound_ms = (
            value * _MS_PER_S for value in (self.difference_s, self.sigma_s, self.bound_s)
        )
        return (
            f"camera {self.camera}: the joint calibration corrects its clock by {difference_ms:+.1f} ms "
            f"(standard deviation {sigma_ms:.1f} ms), but its node states an error below {bound_ms:.1f} ms"
        )


def find_contradicted_clocks(model: Model, estimates: Iterable[ClockEstimate]) -> list[ClockContradiction]:
    """Compare the clocks of a joint model with the estimates of the nodes in the log of its fit.

    Parameters
    ----------
    model : the joint model of this log.
    estimates : all clock estimates of the log.
    """
    bounds_ns: dict[str, list[int]] = {}
    for estimate in estimates:
        bounds_ns.setdefault(estimate.camera, []).append(estimate.bound_ns)
    bounds_s = {camera: float(np.mean(rows)) / NS_PER_S for camera, rows in bounds_ns.items()}
    if not bounds_s:
        return []
    cameras = describe_cameras(model, {}, None)
    reference_s = max(
        (bounds_s.get(camera.camera, 0.0) for camera in cameras if camera.clock_sigma_s == 0), default=0.0
    )
    rows = [
        _compare(camera, bounds_s[camera.camera] + reference_s)
        for camera in cameras
        if camera.camera in bounds_s
    ]
    return [row for row in rows if abs(row.difference_s) > row.bound_s + _SIGMAS * row.sigma_s]


def _compare(camera: CalibratedCamera, bound_s: float) -> ClockContradiction:
    return ClockContradiction(camera.camera, camera.clock_s, camera.clock_sigma_s, bound_s)
