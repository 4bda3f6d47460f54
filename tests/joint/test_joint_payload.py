"""The stored joint model: the floor once for all cameras, and the messages of older versions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.model import JointModel, covariance_modes
from ipsys_log.calibration.joint.payload import PoseChange, joint_payload, mend_poses, restore_joint
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import decode, encode
from ipsys_log.messages import Model, Parameter
from tests.joint.small_lab import Array, make_lab


@pytest.fixture(scope="module")
def fit() -> JointFit:
    return fit_jointly(make_lab(4, points=20, cameras=3)[0])


@pytest.fixture(scope="module")
def payload(fit: JointFit) -> Model:
    stored: Model = decode("ipsys.v1.Model", encode(joint_payload(fit, {}, 0)))
    return stored


def old_payload(fit: JointFit) -> Model:
    """Return the message of versions up to 4: each camera has the floor, below its own modes."""
    payload, layout, modes = joint_payload(fit, {}, 0), fit.problem.layout, covariance_modes(fit.covariance)
    cameras = []
    for camera, block in zip(payload.cameras, layout.cameras, strict=True):
        scale = modes[layout.scales].mean(axis=0)[None]
        whole = np.concatenate([modes[block.start : block.stop], scale, modes[layout.modes]])
        own = {p.name: p for p in (*payload.shared, *camera.parameters) if p.name != "floor_modes"}
        own["modes"] = Parameter("modes", whole.shape, whole.reshape(-1))
        cameras.append(replace(camera, parameters=tuple(own.values())))
    return replace(payload, cameras=tuple(cameras), shared=())


def all_modes(model: JointModel) -> Array:
    """Return the modes of the camera, and below them those of the floor."""
    missing = model.modes.shape[1] - model.floor_modes.shape[1]
    return np.concatenate([model.modes, np.pad(model.floor_modes, ((0, 0), (0, missing)))])


def same_covariances(first: dict[str, JointModel], second: dict[str, JointModel]) -> None:
    """Compare the covariances of all unknowns of two cameras and the floor, also between cameras."""
    for one, two in (("c0", "c0"), ("c0", "c2"), ("c1", "c1")):
        wanted = all_modes(first[one]) @ all_modes(first[two]).T
        sigmas = [np.linalg.norm(all_modes(first[name]), axis=1) for name in (one, two)]
        found = all_modes(second[one]) @ all_modes(second[two]).T
        assert (np.abs(found - wanted) <= 1e-12 * np.outer(*sigmas)).all()


def test_floor_is_stored_once_and_is_its_covariance(fit: JointFit, payload: Model) -> None:
    layout, shared = fit.problem.layout, {p.name for p in payload.shared}
    assert {"floor_modes", "floor_pairs", "floor_amplitudes"} <= shared
    assert not any(shared & {p.name for p in camera.parameters} for camera in payload.cameras)
    models = restore_joint(payload)
    for model, block in zip(models.values(), layout.cameras, strict=True):
        floor_modes = model.floor_modes
        assert np.abs(floor_modes @ floor_modes.T - fit.covariance[layout.modes, layout.modes]).max() < 1e-9
        own = model.modes[3:6, : floor_modes.shape[1]] @ floor_modes.T
        sigma_m = np.sqrt(fit.covariance.diagonal()[block.start + 3 : block.start + 6, None])
        wanted = fit.covariance[block.start + 3 : block.start + 6, layout.modes]
        assert (np.abs(own - wanted) < 1e-4 * sigma_m).all()
    # The floor of each camera took most of the message.
    assert len(encode(payload)) < len(encode(old_payload(fit))) / 3


def test_message_of_an_older_version_has_the_same_covariances(fit: JointFit, payload: Model) -> None:
    stored: Model = decode("ipsys.v1.Model", encode(old_payload(fit)))
    same_covariances(restore_joint(stored), restore_joint(payload))


def test_mended_model_shares_the_floor_in_both_layouts(fit: JointFit, payload: Model) -> None:
    change = PoseChange(np.array([0.01, 0, 0, 0, 0.002, 0]), np.diag(np.full(6, 1e-6)))
    mended = [mend_poses(stored, {"c1": change}, 1) for stored in (old_payload(fit), payload)]
    assert all("floor_modes" in {p.name for p in stored.shared} for stored in mended)
    first, second = (restore_joint(stored) for stored in mended)
    same_covariances(first, second)
    before, after = (np.linalg.norm(one["c1"].modes, axis=1) for one in (restore_joint(payload), second))
    np.testing.assert_allclose(after[:6] ** 2 - before[:6] ** 2, 1e-6)
    np.testing.assert_array_equal(second["c0"].origin_m, restore_joint(payload)["c0"].origin_m)


def test_parameter_of_a_camera_replaces_the_shared_one(payload: Model) -> None:
    first, *others = payload.cameras
    floor = next(p for p in payload.shared if p.name == "floor_amplitudes")
    other = replace(floor, values=floor.values + 1.0)
    changed = replace(first, parameters=(*first.parameters, other))
    models = restore_joint(replace(payload, cameras=(changed, *others)))
    np.testing.assert_array_equal(models["c0"].amplitudes, floor.values + 1.0)
    np.testing.assert_array_equal(models["c1"].amplitudes, floor.values)


@pytest.mark.parametrize("name", ["floor_modes", "floor_pairs"])
def test_model_without_its_floor_is_refused(payload: Model, name: str) -> None:
    damaged = replace(payload, shared=tuple(p for p in payload.shared if p.name != name))
    with pytest.raises(IpsysError, match=r"camera c0: the stored model joint is not complete .*fit it again"):
        restore_joint(damaged)
