"""The simulated lab of live cameras: most markers are stationary, a few drive to and fro.

A stationary marker can be used for alignment and measured at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

import cv2
import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.patterns import true_corners
from ipsys_log.messages import Rig, RigCamera, RigMarker
from ipsys_log.rig.checks import dictionary_size
from ipsys_log.simulation.calibration_points import (
    REFERENCES,
    Place,
    choose_place,
    place,
    seen_whole,
    tape_lengths_m,
)
from ipsys_log.simulation.cameras import Camera, hang_cameras
from ipsys_log.simulation.drive import Drive, plan_drive
from ipsys_log.simulation.lab import build_rig
from ipsys_log.simulation.seeds import Purpose, stream
from ipsys_log.simulation.settings import LabSettings
from ipsys_log.units import CM_PER_M

__all__ = ["LIVE_SETTINGS", "LiveLab", "live_rig", "plan_live_lab", "tape_sheet"]

# A laptop with two cores draws it and tracks in it: three cameras give 2.5 MB a second.
LIVE_SETTINGS = LabSettings(
    width=1280, height=720, rate_hz=10.0, stations=18, drive_s=4.0, noise_sigma=1.0, jpeg_quality=80
)
# Most markers lie on the floor, for the alignment of cameras; the others lie on boxes.
_RAISED_SHARE, _BOXES_M = 0.35, (0.1, 0.2)
# Samples per second of the driving markers' paths; stationary markers keep clear of these places.
_CHECKED_HZ = 5
# The places do not depend on the size of the frames, as long as these are wide.
_WIDTH, _HEIGHT = 1920, 1080
# A marker that is narrower in an image of this width may be missed in a smaller one.
_NARROWEST_PX = 50.0

_planning = Lock()


@dataclass(frozen=True, slots=True, eq=False)
class LiveLab:
    """Places of markers: those with ids from ``settings.markers`` on are stationary, the others drive."""

    settings: LabSettings
    drive: Drive
    lying: tuple[Place, ...]


def plan_live_lab(settings: LabSettings) -> LiveLab:
    """Plan a lab in which each camera sees about ``settings.stations`` stationary markers.

    Parameters
    ----------
    settings : all determine the places, except the size, rate and quality of the frames.

    Raises
    ------
    IpsysError
        The lab has no room for so many markers.

    Examples
    --------
    >>> lab = plan_live_lab(LabSettings(stations=4, markers=2, drive_s=2.0))
    >>> [place.marker_id for place in lab.lying][:3], sorted(lab.drive.ahead_s)
    ([2, 3, 4], [0, 1])
    """
    shape = replace(settings, width=_WIDTH, height=_HEIGHT, rate_hz=LIVE_SETTINGS.rate_hz)
    with _planning:  # the cameras of a lab are opened at once, and share one plan
        drive, lying = _plan(shape)
    return LiveLab(settings, drive, lying)


@lru_cache(maxsize=4)
def _plan(settings: LabSettings) -> tuple[Drive, tuple[Place, ...]]:
    cameras = hang_cameras(settings)
    drive = plan_drive(settings, cameras)
    times_s = np.linspace(0, settings.drive_s, round(settings.drive_s * _CHECKED_HZ) + 1).tolist()
    taken = [where for time_s in times_s for where in drive.places_at(time_s)]
    rng = stream(settings.seed, Purpose.LYING)
    seen: dict[str, list[Place]] = {camera.name: [] for camera in cameras}
    lying: list[Place] = []
    while min(map(len, seen.values())) < settings.stations:
        camera = min(cameras, key=lambda one: len(seen[one.name]))
        number = settings.markers + len(lying)
        _check_left(settings, number)
        level = replace(settings, heights_m=(_next_height_m(lying, seen[camera.name]),))
        others = [*taken, *lying]
        where = choose_place(rng, level, cameras, camera, number, others, seen[camera.name], _is_wide)
        lying.append(where)
        for name in seen_whole(where, cameras, settings):
            seen[name].append(where)
    return drive, tuple(lying)


def _next_height_m(lying: Sequence[Place], seen: Sequence[Place]) -> float:
    """Return the height of the next marker: each camera sees only a small share of raised markers."""
    raised = sum(where.z_m > 0 for where in seen)
    if raised >= _RAISED_SHARE * len(seen):
        return 0.0
    return _BOXES_M[sum(where.z_m > 0 for where in lying) % len(_BOXES_M)]


def _is_wide(where: Place, camera: Camera, settings: LabSettings) -> bool:
    """Return whether a marker is wide enough in the image of a camera with a slanted view."""
    corners_px = true_corners(camera.lens, camera.camera_from_world, place(where, settings))
    area_px = cv2.contourArea(corners_px.astype(np.float32))
    longest_px = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1).max()
    return bool(area_px / longest_px >= _NARROWEST_PX)


def _check_left(settings: LabSettings, number: int) -> None:
    """Check that the dictionary has a marker of this number."""
    size = dictionary_size(settings.dictionary)
    if size is not None and number >= size:
        raise IpsysError(
            f"simulator: {settings.dictionary} has {size} markers: too few for {settings.markers} that drive "
            f"and {settings.stations} that lie before each camera; set fewer stations"
        )


def live_rig(settings: LabSettings) -> Rig:
    """Return the rig of the live lab: each camera with its source, each marker with its height."""
    rig = build_rig(settings)
    lying = plan_live_lab(settings).lying
    cameras = (
        RigCamera(name, None, None, f"sim:{name}", settings.width, settings.height, settings.rate_hz)
        for name in settings.cameras
    )
    still = (RigMarker(where.marker_id, height_m=where.z_m) for where in lying)
    return replace(rig, cameras=tuple(cameras), markers=(*rig.markers, *still))


def tape_sheet(lying: Sequence[Place]) -> str:
    """Return the tape and ruler readings of stationary markers, as a sheet for ``ipsys measure --csv``.

    Examples
    --------
    >>> print(tape_sheet([Place(3, 1.2192, 3.4384, 0.1, 0.0)]))
    marker,d_A_cm,d_B_cm,side,height_cm
    3,100.0,263.5,left,10.0
    <BLANKLINE>
    """
    a, b = REFERENCES
    rows = [f"marker,d_{a.name}_cm,d_{b.name}_cm,side,height_cm"]
    for where in lying:
        tapes = ",".join(f"{CM_PER_M * length_m:.1f}" for length_m in tape_lengths_m(where).tolist())
        side = "left" if where.y_m >= a.y_m else "right"
        rows.append(f"{where.marker_id},{tapes},{side},{CM_PER_M * where.z_m:.1f}")
    return "\n".join(rows) + "\n"
