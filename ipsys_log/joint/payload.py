"""The joint model as the payload of a log: named arrays for each camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import DISTORTION_MODELS
from ipsys_log.joint.fit import JointFit
from ipsys_log.joint.model import JointModel, build_models
from ipsys_log.messages import CameraCalibration, CameraModel, Model, Pair, Parameter

__all__ = ["JOINT", "joint_payload", "restore_joint", "store_joint"]

# The name of the model in commands and logs.
JOINT = "joint"

_LENSES = {count: name for name, count in DISTORTION_MODELS.items()}


def joint_payload(fit: JointFit, pairs: Mapping[str, Sequence[Pair]], time_ns: int) -> Model:
    """Return the payload of a joint calibration, with the calibration points that each camera saw."""
    cameras = [
        CameraModel(camera, store_joint(model), pairs=tuple(pairs.get(camera, ())))
        for camera, model in build_models(fit).items()
    ]
    return Model(time_ns, JOINT, tuple(cameras))


def store_joint(model: JointModel) -> tuple[Parameter, ...]:
    """Return the parameters of the payload of a camera's model, sorted by name."""
    arrays = sorted(model.to_arrays().items())
    return tuple(Parameter(name, array.shape, array.reshape(-1)) for name, array in arrays)


def restore_joint(camera: CameraModel) -> JointModel:
    """Return the joint model of a camera from its payload.

    Raises
    ------
    IpsysError
        A parameter is missing, or has the wrong shape.
    """
    try:
        arrays = {p.name: np.asarray(p.values, dtype=np.float64).reshape(p.shape) for p in camera.parameters}
        # The number of coefficients names the lens model.
        name = _LENSES[len(arrays["lens"]) - 4]
        return JointModel.from_arrays(
            arrays, CameraCalibration(0, camera.camera, 0, 0, name, arrays["lens"][4:], np.eye(3))
        )
    except (KeyError, ValueError, TypeError) as error:
        raise IpsysError(
            f"camera {camera.camera}: the stored model {JOINT} is not complete ({error}); fit it again"
        ) from error
