"""Cameras with large tilts, which see the floor from the side."""

import numpy as np

from ipsys_log.capture.simulation.cameras import Camera, draw_lens, reaches, row_of_cameras
from ipsys_log.capture.simulation.settings import FLOOR_M, LabSettings, Purpose, random_stream
from ipsys_log.vision.poses import look_down


def aim_cameras(settings: LabSettings) -> tuple[Camera, ...]:
    """Return cameras with large tilts, each aimed at the point of the floor below its place in the row.

    A camera with a tilt of t stands ``height * tan(t)`` beside its place, at most at the walls.
    `mount_cameras` refuses such tilts, because a tilted camera does not see its part of the floor.
    """
    ys_m, _ = row_of_cameras(len(settings.cameras))
    return tuple(_aim(settings, index, y_m) for index, y_m in enumerate(ys_m.tolist()))


def _aim(settings: LabSettings, index: int, y_m: float) -> Camera:
    rng = random_stream(settings.seed, Purpose.GEOMETRY, index)
    name = settings.cameras[index]
    while not reaches(lens := draw_lens(rng, settings, name, 0)):
        pass
    tilt = np.radians(rng.uniform(*settings.tilt_deg))
    towards = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    aside = look_down(np.zeros(3), tilt * axis)[2, :3]
    place_m = np.array([FLOOR_M / 2, y_m]) + settings.mount_height_m * aside[:2] / aside[2]
    nudge_m = rng.uniform(-1, 1, 3) * [0.02, 0.02, 0.04]
    origin_m = np.append(np.clip(place_m, 0.0, FLOOR_M), settings.mount_height_m) + nudge_m
    return Camera(name, lens, look_down(origin_m, tilt * axis))
