"""Turn a camera exactly by the text of an advice."""

import re

import numpy as np
from numpy.typing import NDArray

from ipsys_log.vision.poses import invert_pose, make_pose, rotation

Array = NDArray[np.float64]


def follow(advice: str, camera_from_world: Array) -> Array:
    """Return the camera pose, (4, 4), after the camera was turned without a change of its position."""
    degrees = dict.fromkeys(("right", "left", "bottom", "top"), 0.0)
    for angle, way in re.findall(r"([\d.]+) degrees towards the (\w+)", advice):
        degrees[way] += float(angle)
    right, down = np.radians([degrees["right"] - degrees["left"], degrees["bottom"] - degrees["top"]])
    # A turn to the right is a rotation about the axis that points down in the image. A turn down is a
    # rotation about the axis that points to the left.
    turned = rotation(np.array([0.0, right, 0.0])) @ rotation(np.array([-down, 0.0, 0.0]))
    world_from_camera = invert_pose(camera_from_world)
    return invert_pose(make_pose(world_from_camera[:3, :3] @ turned, world_from_camera[:3, 3]))
