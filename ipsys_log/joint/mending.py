"""A joint model with new poses of moved cameras, without a new fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.poses import rotation
from ipsys_log.joint.payload import restore_joint, store_joint
from ipsys_log.messages import Model

__all__ = ["PoseChange", "mend_poses"]

Array = NDArray[np.float64]

_POSE = 6


class PoseChange(NamedTuple):
    """The motion (6,) of a camera, a turn about its axes and a shift in the world, with its covariance."""

    motion: Array
    covariance: Array


def mend_poses(model: Model, changes: Mapping[str, PoseChange], time_ns: int) -> Model:
    """Return a joint model whose moved cameras have their new poses.

    Each motion adds six modes: its errors are independent of those of the calibration. For all other cameras,
    these modes are 0, so the covariance of any two cameras stays the product of their modes.

    Parameters
    ----------
    model : the joint model before the motions.
    changes : motions by camera; a camera that is not in the model has no effect.
    time_ns : time of the new model.

    Raises
    ------
    IpsysError
        The model is not complete.
    """
    moved = [camera.camera for camera in model.cameras if camera.camera in changes]
    cameras = []
    for camera in model.cameras:
        joint = restore_joint(camera)
        more = np.zeros((len(joint.modes), _POSE * len(moved)))
        if camera.camera in changes:
            motion, covariance = changes[camera.camera]
            first = _POSE * moved.index(camera.camera)
            more[:_POSE, first : first + _POSE] = np.linalg.cholesky(covariance)
            turned = rotation(motion[:3]) @ joint.camera_from_world
            joint = replace(joint, camera_from_world=turned, origin_m=joint.origin_m + motion[3:])
        joint = replace(joint, modes=np.hstack([joint.modes, more]))
        cameras.append(replace(camera, parameters=store_joint(joint)))
    return replace(model, timestamp=time_ns, cameras=tuple(cameras))
