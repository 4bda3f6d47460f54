"""A rendered lab with known truth: three fisheye cameras above markers on a floor.

:func:`simulate` yields a whole session. :func:`prepare_view`, :func:`render` and
:func:`true_corners` draw single frames, for tests and benchmarks; :func:`plan_drive` and
:func:`drive_start_ns` tell where the driving markers are at any time.
"""

from ipsys_log.sources.simulator.cameras import Camera, hang_cameras
from ipsys_log.sources.simulator.drive import Drive, plan_drive
from ipsys_log.sources.simulator.patterns import Moving, Placed, true_corners
from ipsys_log.sources.simulator.render import encode_jpeg, expose, render
from ipsys_log.sources.simulator.settings import LabSettings
from ipsys_log.sources.simulator.simulate import EPOCH_NS, drive_start_ns, simulate
from ipsys_log.sources.simulator.views import View, prepare_view

__all__ = [
    "EPOCH_NS",
    "Camera",
    "Drive",
    "LabSettings",
    "Moving",
    "Placed",
    "View",
    "drive_start_ns",
    "encode_jpeg",
    "expose",
    "hang_cameras",
    "plan_drive",
    "prepare_view",
    "render",
    "simulate",
    "true_corners",
]
