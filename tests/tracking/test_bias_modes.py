"""Modes of calibration errors keep the covariances of the models."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import joint_payload, restore_joint
from ipsys_log.messages import Model, Pair, Rig, RigMarker
from ipsys_log.models.table import AppliedModel
from ipsys_log.models.tracking import bias_modes as modes_module
from ipsys_log.models.tracking import calibration_modes as table_module
from ipsys_log.models.tracking.bias_modes import LOCAL_M, BiasModes, Grid, NodeModes, reduce_modes
from ipsys_log.models.tracking.calibration_modes import calibration_modes
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import pose_facing_up, transform
from tests.joint.small_lab import LENGTH_M, make_lab

Array = NDArray[np.float64]

GRID = Grid(np.array([-1.0, 0.0]), 0.5, (5, 4))


def linear_nodes(rng: np.random.Generator, count: int) -> tuple[Array, NodeModes]:
    """Return planes (3, 3, M) of the modes over 1, x, y; and the modes at the nodes."""
    planes = rng.standard_normal((3, 3, count))
    terms = np.column_stack([np.ones(20), GRID.points_m])
    return planes, NodeModes(np.einsum("nt,tam->nam", terms, planes), np.zeros((20, 3, 3)), np.zeros(count))


def test_plane_of_sensitivities_is_exact_between_nodes() -> None:
    rng = np.random.default_rng(0)
    planes, nodes = linear_nodes(rng, 4)
    modes = reduce_modes(GRID, {"red": nodes}, 4)
    points_m = rng.uniform([-1, 0], [1, 1.5], (30, 2))
    headings = rng.uniform(-3, 3, 30)
    sensitivities = modes.at("red", points_m, headings)
    terms = np.column_stack([np.ones(30), points_m])
    wanted = np.einsum("nt,tam->nam", terms, planes)
    # The amplitudes are turned; covariances do not change.
    np.testing.assert_allclose(
        sensitivities[:, :3] @ sensitivities[:, :3].swapaxes(1, 2), wanted @ wanted.swapaxes(1, 2), atol=1e-9
    )
    np.testing.assert_allclose(
        sensitivities[0, :3] @ sensitivities[9, :3].T, wanted[0] @ wanted[9].T, atol=1e-9
    )


def test_turn_of_the_camera_turns_all_headings_alike() -> None:
    turn = np.zeros((20, 3, 1))
    turn[:, 0, 0], turn[:, 1, 0] = -0.01 * GRID.points_m[:, 1], 0.01 * GRID.points_m[:, 0]
    modes = reduce_modes(GRID, {"red": NodeModes(turn, np.zeros((20, 3, 3)), np.zeros(1))}, 1)
    sensitivities = modes.at("red", np.full((5, 2), 0.3), np.linspace(-3, 3, 5))
    np.testing.assert_allclose(np.abs(sensitivities[:, 3, 0]), 0.01, rtol=1e-9)


def test_modes_left_out_stay_in_the_covariance() -> None:
    rng = np.random.default_rng(1)
    nodes = {
        name: NodeModes(rng.standard_normal((20, 3, 9)), np.zeros((20, 3, 3)), np.zeros(9)) for name in "ab"
    }
    modes = reduce_modes(GRID, nodes, 4)
    assert modes.count == 4 + 3 * 2
    assert modes.fade_m.tolist() == [np.inf] * 4 + [LOCAL_M] * 6
    sensitivities = modes.at("b", GRID.points_m, np.zeros(20))
    total = sensitivities[:, :3] @ sensitivities[:, :3].swapaxes(1, 2)
    np.testing.assert_allclose(total, nodes["b"].modes_m @ nodes["b"].modes_m.swapaxes(1, 2), atol=1e-9)


def test_node_that_a_camera_cannot_see_has_the_nearest_value() -> None:
    values = np.ones((20, 3, 1))
    values[GRID.points_m[:, 0] > 0.2] = np.nan
    values[GRID.points_m[:, 0] < -0.7] = 5.0
    modes = reduce_modes(GRID, {"red": NodeModes(values, np.zeros((20, 3, 3)), np.zeros(1))}, 1)
    sensitivities = modes.at("red", np.array([[1.0, 1.0], [40.0, 1.0], [-1.0, 0.5]]), np.zeros(3))
    np.testing.assert_allclose(np.abs(sensitivities[:, 0, 0]), [1.0, 1.0, 5.0])


@given(
    st.lists(st.booleans(), min_size=20, max_size=20),
    st.lists(st.integers(0, 19), min_size=1, unique=True),
)
def test_nodes_outside_of_a_view_have_the_nearest_value(seen: list[bool], nodes: list[int]) -> None:
    """A camera with any part of the nodes, of which it sees any part: compared with all distances."""
    rows = np.array(sorted(nodes))
    values = np.random.default_rng(6).uniform(1.0, 2.0, (len(rows), 3, 1))
    values[~np.array(seen)[rows]] = np.nan
    modes = reduce_modes(GRID, {"red": NodeModes(values, np.zeros((len(rows), 3, 3)), np.zeros(1), rows)}, 1)
    known = np.isfinite(values[:, 0, 0])
    sensitivities = np.abs(modes.at("red", GRID.points_m, np.zeros(20))[:, :3, 0])
    apart_m = np.linalg.norm(GRID.points_m[:, None] - GRID.points_m[rows[known]], axis=2)
    if not known.any():
        assert not sensitivities.any()
        return
    for distances_m, found in zip(apart_m, sensitivities, strict=True):
        nearest = np.flatnonzero(distances_m <= distances_m.min() + 1e-9)
        assert any(np.allclose(found, values[known][row, :, 0]) for row in nearest)


def test_unknown_camera_has_no_errors() -> None:
    sensitivities = BiasModes.none().at("red", np.zeros((2, 3)), np.zeros(2))
    assert sensitivities.shape == (2, 4, 0)


@pytest.fixture(scope="module")
def joint() -> Model:
    return joint_payload(fit_jointly(make_lab(4, points=20)[0]), {}, 0)


def rig_with(height_sigma_m: float | None) -> Rig:
    return Rig(
        "lab",
        "DICT_4X4_100",
        LENGTH_M,
        (RigMarker(0, robot="ada"),),
        marker_height_m=0.1,
        marker_height_sigma_m=height_sigma_m,
    )


@pytest.fixture(params=["lab", "hall"])
def size(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Let a small lab count as a hall, whose cameras have nodes in their views only."""
    if request.param == "hall":
        monkeypatch.setattr(table_module, "_MOST_NODES", 0)
        monkeypatch.setattr(modes_module, "_NODES_AT_ONCE", 7)
    return str(request.param)


@pytest.mark.usefixtures("size")
@pytest.mark.parametrize("sigma_m", [None, 0.0001, 0.004])
def test_joint_modes_are_the_covariance_of_located_markers(joint: Model, sigma_m: float | None) -> None:
    """The part of the calibration in the covariance of real sightings, against the table."""
    rig = rig_with(sigma_m)
    modes = calibration_modes(joint, rig)
    assert modes.count == 12 + 3 * len(joint.cameras)
    rng = np.random.default_rng(5)
    for camera, model in restore_joint(joint).items():
        places_m = model.origin_m[:2] + rng.uniform(-0.9, 0.9, (20, 2))
        headings = rng.uniform(-3, 3, 20)
        corners_px = level_corners(model, places_m, headings)
        noise = np.broadcast_to(0.012**2 * np.eye(8), (20, 8, 8))
        sizes = np.full(20, 0.1), np.full(20, LENGTH_M)
        located = locate_markers(model, corners_px, noise, *sizes, sigma_m or 0.001)
        wanted = (located.covariances_m2 - located.noise_m2)[:, :2, :2]
        sensitivities = modes.at(camera, located.points_m, located.headings_rad)
        total = sensitivities[:, :2] @ sensitivities[:, :2].swapaxes(1, 2)
        ratio = np.trace(total, axis1=1, axis2=2) / np.trace(wanted, axis1=1, axis2=2)
        assert np.abs(ratio - 1).max() < 0.1


def level_corners(model: JointModel, places_m: Array, headings_rad: Array) -> Array:
    """Return corners (n, 4, 2) of level markers 10 cm above the floor, by OpenCV's projection."""
    floor_m, _ = model.floor.heights(places_m, model.amplitudes)
    corners = []
    for (x_m, y_m), z_m, heading_rad in zip(places_m, floor_m + 0.1, headings_rad, strict=True):
        world_m = transform(pose_facing_up(x_m, y_m, z_m, heading_rad), marker_corners(LENGTH_M))
        camera_m = (world_m - model.origin_m) @ model.camera_from_world.T
        corners.append(project(camera_m, model.calibration))
    return np.array(corners)


def test_camera_of_a_hall_has_nodes_in_its_view_only(joint: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table continues outside of the view with the values of its edge."""
    monkeypatch.setattr(table_module, "_MOST_NODES", 0)
    monkeypatch.setattr(table_module, "_VIEW_MARGIN", 0.5)
    modes, model = calibration_modes(joint, rig_with(None)), restore_joint(joint)[joint.cameras[0].camera]
    edges = [model.origin_m[:2] + np.array([reach_m, 0.0]) for reach_m in (1.6, 1.8)]
    near, far = (modes.at(joint.cameras[0].camera, np.array([place_m]), np.zeros(1)) for place_m in edges)
    # The shares of equal nodes are rounded: they depend on the place in its cell.
    rounding = 8 * np.finfo(np.float64).eps * np.abs(far[:, 0]).max()
    np.testing.assert_allclose(near[:, 0], far[:, 0], rtol=0, atol=rounding)


@pytest.mark.usefixtures("size")
@pytest.mark.parametrize(
    ("name", "sigma_m"), [("poly", None), ("best", None), ("rayplane", None), ("rayplane", 0.004)]
)
def test_modes_of_a_table_model_are_its_covariance(name: str, sigma_m: float | None) -> None:
    rng = np.random.default_rng(3)
    camera_m = np.column_stack([rng.uniform(-1.2, 1.2, (30, 2)), rng.uniform(1.9, 2.1, 30)])
    turn = np.diag([1.0, -1.0, -1.0])
    world_m = camera_m @ turn + np.array([2.0, 2.0, 2.1])
    measured_m = world_m + rng.normal(0.0, 0.002, world_m.shape)
    tape_m2 = 0.002**2 * np.eye(3)
    pairs = {
        "red": [
            Pair(str(n), 0, seen, place, 5, tape_m2)
            for n, (seen, place) in enumerate(zip(camera_m, measured_m, strict=True))
        ]
    }
    model = fit_model(name, pairs, 0)
    modes = calibration_modes(model, rig_with(sigma_m), 19)
    points_m = np.column_stack([rng.uniform(-0.8, 0.8, (15, 2)), np.full(15, 2.0)])
    applied = AppliedModel(name, model.cameras[0])
    heights_m = np.full(15, 0.1)
    sigmas_m = None if sigma_m is None else np.full(15, sigma_m)
    wanted = applied.covariances(points_m, heights_m, sigmas_m)
    assert wanted is not None
    places_m = applied.predict(points_m, heights_m)
    sensitivities = modes.at("red", places_m, np.zeros(15))
    total = sensitivities[:, :3] @ sensitivities[:, :3].swapaxes(1, 2)
    ratio = np.trace(total, axis1=1, axis2=2) / np.trace(wanted, axis1=1, axis2=2)
    assert np.abs(ratio - 1).max() < 0.15
