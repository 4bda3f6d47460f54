"""Somebody on a ladder, who does to a camera what the words say and nothing else."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.poses import invert_pose, make_pose, rotation

Array = NDArray[np.float64]


def follow(advice: str, camera_from_world: Array) -> Array:
    """The camera, (4, 4), after it was tilted where it hangs."""
    degrees = dict.fromkeys(("right", "left", "bottom", "top"), 0.0)
    for way, angle in re.findall(r"towards the (\w+)[a-z ]*, by ([\d.]+) degrees", advice):
        degrees[way] += float(angle)
    right, down = np.radians([degrees["right"] - degrees["left"], degrees["bottom"] - degrees["top"]])
    # To look to the right is a turn about the axis that points down in the picture; to look down, one about
    # the axis that then points to the left.
    turned = rotation(np.array([0.0, right, 0.0])) @ rotation(np.array([-down, 0.0, 0.0]))
    world_from_camera = invert_pose(camera_from_world)
    return invert_pose(make_pose(world_from_camera[:3, :3] @ turned, world_from_camera[:3, 3]))
