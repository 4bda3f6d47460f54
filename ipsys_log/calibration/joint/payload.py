"""The joint model as the payload of a log: named arrays of each camera, and of the floor.

A model can get new poses of moved cameras without a new fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration, CameraModel, Model, Pair, Parameter
from ipsys_log.vision.lenses import DISTORTION_MODELS
from ipsys_log.vision.poses import rotation, rotation_vector

# The name of the model in commands and logs.
JOINT = "joint"

# The floor belongs to all cameras. Its modes are most of the model of a hall.
_FLOOR = (
    "floor_amplitudes",
    "floor_along_x",
    "floor_along_y",
    "floor_grid_m",
    "floor_modes",
    "floor_pairs",
)
_LENSES = {count: name for name, count in DISTORTION_MODELS.items()}
_POSE = 6


def joint_payload(fit: JointFit, pairs: Mapping[str, Sequence[Pair]], time_ns: int) -> Model:
    """Return the payload of a joint calibration, with the calibration points that each camera saw."""
    models = build_models(fit)
    cameras = tuple(CameraModel(camera, (), pairs=tuple(pairs.get(camera, ()))) for camera in models)
    return store_joint(Model(time_ns, JOINT, cameras), models)


def store_joint(payload: Model, models: Mapping[str, JointModel]) -> Model:
    """Return a payload with the parameters of its cameras' models, sorted by name.

    Parameters of the floor that all cameras have in common are stored once.
    """
    arrays = [models[camera.camera].to_arrays() for camera in payload.cameras]
    shared = {
        name: arrays[0][name]
        for name in (_FLOOR if arrays else ())
        if all(np.array_equal(own[name], arrays[0][name]) for own in arrays)
    }
    cameras = tuple(
        replace(camera, parameters=_parameters({name: own[name] for name in own.keys() - shared.keys()}))
        for camera, own in zip(payload.cameras, arrays, strict=True)
    )
    return replace(payload, cameras=cameras, shared=_parameters(shared))


def _parameters(arrays: Mapping[str, Array]) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, array.shape, array.reshape(-1)) for name, array in sorted(arrays.items()))


def restore_joint(payload: Model) -> dict[str, JointModel]:
    """Return the joint model of each camera from a payload, by the name of the camera."""
    return {camera.camera: _restore(camera, payload.shared) for camera in payload.cameras}


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
    """
    joints = {
        name: move_camera(joint, changes[name].motion) if name in changes else joint
        for name, joint in restore_joint(model).items()
    }
    joints = add_pose_modes(joints, {name: change.covariance for name, change in changes.items()})
    return replace(store_joint(model, joints), timestamp=time_ns)


def add_pose_modes(
    joints: Mapping[str, JointModel], covariances: Mapping[str, Array]
) -> dict[str, JointModel]:
    """Return cameras whose poses have further errors with covariances (6, 6): six modes for each of these."""
    moved = [name for name in joints if name in covariances]
    wider = {}
    for name, joint in joints.items():
        more = np.zeros((len(joint.modes), _POSE * len(moved)))
        if name in covariances:
            first = _POSE * moved.index(name)
            more[:_POSE, first : first + _POSE] = np.linalg.cholesky(covariances[name])
        wider[name] = replace(joint, modes=np.hstack([joint.modes, more]))
    return wider


def move_camera(camera: JointModel, motion: Array) -> JointModel:
    """Return a camera after a motion (6,): a turn about its axes, and a shift in the world."""
    turned = rotation(motion[:3]) @ camera.camera_from_world
    return replace(camera, camera_from_world=turned, origin_m=camera.origin_m + motion[3:])


def find_motion(before: JointModel, after: JointModel) -> Array:
    """Return the motion (6,) of a camera, as :func:`move_camera` takes it."""
    turn_rad = rotation_vector(after.camera_from_world @ before.camera_from_world.T)
    return np.concatenate([turn_rad, after.origin_m - before.origin_m])


def _restore(camera: CameraModel, shared: Sequence[Parameter]) -> JointModel:
    try:
        arrays = {
            p.name: np.asarray(p.values, dtype=np.float64).reshape(p.shape)
            for p in (*shared, *camera.parameters)
        }
        # The number of coefficients names the lens model.
        name = _LENSES[len(arrays["lens"]) - 4]
        return JointModel.from_arrays(
            arrays, CameraCalibration(0, camera.camera, 0, 0, name, arrays["lens"][4:], np.eye(3))
        )
    except (KeyError, ValueError, TypeError) as error:
        raise IpsysError(
            f"camera {camera.camera}: the stored model {JOINT} is not complete ({error}); fit it again"
        ) from error
