"""A rendered lab with known truth: three fisheye cameras above markers on a floor.

:func:`simulate` yields a whole session. :func:`prepare_view`, :func:`render` and
:func:`true_corners` draw single frames, for tests and benchmarks.
"""

from ipsys_log.sources.simulator.cameras import Camera, hang_cameras
from ipsys_log.sources.simulator.patterns import Placed, true_corners
from ipsys_log.sources.simulator.render import View, encode_jpeg, expose, prepare_view, render
from ipsys_log.sources.simulator.settings import LabSettings
from ipsys_log.sources.simulator.simulate import EPOCH_NS, simulate

__all__ = [
    "EPOCH_NS",
    "Camera",
    "LabSettings",
    "Placed",
    "View",
    "encode_jpeg",
    "expose",
    "hang_cameras",
    "prepare_view",
    "render",
    "simulate",
    "true_corners",
]
