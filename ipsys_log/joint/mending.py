"""A joint model with new poses of moved cameras, without a new fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ipsys_log.arrays import Array
from ipsys_log.geometry.poses import rotation
from ipsys_log.joint.payload import restore_joint, store_joint
from ipsys_log.messages import Model

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
    joints = restore_joint(model)
    for name, joint in joints.items():
        more = np.zeros((len(joint.modes), _POSE * len(moved)))
        if name in changes:
            motion, covariance = changes[name]
            first = _POSE * moved.index(name)
            more[:_POSE, first : first + _POSE] = np.linalg.cholesky(covariance)
            turned = rotation(motion[:3]) @ joint.camera_from_world
            joints[name] = replace(joint, camera_from_world=turned, origin_m=joint.origin_m + motion[3:])
        joints[name] = replace(joints[name], modes=np.hstack([joint.modes, more]))
    return replace(store_joint(model, joints), timestamp=time_ns)
