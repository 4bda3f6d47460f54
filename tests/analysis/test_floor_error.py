"""The error over the floor, compared with brute force, closed forms and the stages."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import Delaunay

from ipsys_log.capture.simulation.cameras import sees
from ipsys_log.capture.simulation.settings import FLOOR_M, LabSettings
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration, CameraPoints, Marker, Markers, Message, Positions, Rig
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.stages.camera_frame import CameraFrame
from ipsys_log.statistics.calibration_points import build_pairs, gather_sightings, valid_measurements
from ipsys_log.statistics.camera_models import fit_model
from tests.geometric.floor_error import (
    KnownSightings,
    Locator,
    align_rigidly,
    compute_errors,
    grid_nodes,
    locate_with_model,
    outside_hull,
    region_shares,
    summarize,
)
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

Array = NDArray[np.float64]

# No node of the grid is on an edge of this hull.
MEASURED_M = np.array([[1.03, 1.01, 0.0], [4.02, 1.05, 0.1], [4.07, 4.04, 0.0], [1.06, 4.01, 0.2]])


@pytest.fixture(scope="module")
def lab() -> GeometricLab:
    return build_lab(
        GeometricSettings(lab=LabSettings(rate_hz=10.0, drive_s=0.0), points=30, floor_rms_m=0.002)
    )


def nodes_of(lab: GeometricLab) -> list[KnownSightings]:
    return [
        grid_nodes(
            camera.lens,
            camera.camera_from_world,
            lambda poses, side_m: lab.place(poses).corners_m(side_m),
            (FLOOR_M, FLOOR_M),
            0.1,
            0.2,
        )
        for camera in lab.cameras
    ]


@pytest.fixture(scope="module")
def nodes(lab: GeometricLab) -> list[KnownSightings]:
    return nodes_of(lab)


def displaced(
    nodes: list[KnownSightings], errors_m: dict[str, Array], covariances_m2: Array | None = None
) -> Locator:
    """Return a locator with known errors."""
    truth_m = {seen.camera: seen.truth_m for seen in nodes}

    def locate(
        camera: str, corners_px: Array, heights_m: Array, covariances_px2: Array | None = None
    ) -> tuple[Array, Array | None]:
        assert corners_px.shape == (len(truth_m[camera]), 4, 2)
        positions_m = np.column_stack([truth_m[camera] + errors_m[camera], heights_m])
        return positions_m, covariances_m2

    return locate


def test_nodes_are_all_places_at_which_a_larger_square_is_seen(
    lab: GeometricLab, nodes: list[KnownSightings]
) -> None:
    axis_m = np.arange(3, 46) / 10
    for camera, seen in zip(lab.cameras, nodes, strict=True):
        wanted = [
            (x_m, y_m)
            for x_m in axis_m
            for y_m in axis_m
            if sees(camera, lab.place(np.array([[x_m, y_m, 0.1, 0.0]])).corners_m(0.28)[0]).all()
        ]
        assert seen.camera == camera.name
        assert len(seen.truth_m) == len(wanted) > 500
        assert seen.truth_m == pytest.approx(np.array(wanted))
        assert (seen.heights_m == 0.1).all()


def test_constant_error_is_the_mean_and_vanishes_with_alignment(nodes: list[KnownSightings]) -> None:
    shift_m = {seen.camera: np.array([0.003, 0.004]) for seen in nodes}
    error = summarize(compute_errors(nodes, displaced(nodes, shift_m)), MEASURED_M)
    assert error.mean_m == pytest.approx(0.005)
    assert error.p95_m == pytest.approx(0.005)
    assert error.aligned_mean_m == pytest.approx(0.0, abs=1e-12)
    assert error.count == sum(len(seen.truth_m) for seen in nodes)
    assert (error.missing, error.shares) == (0, None)


def test_errors_outside_the_hull_count_by_themselves(nodes: list[KnownSightings]) -> None:
    inside = {
        seen.camera: Delaunay(MEASURED_M[:, :2]).find_simplex(seen.truth_m, tol=1e-12) >= 0 for seen in nodes
    }
    errors_m = {name: np.where(mask[:, None], [0.001, 0], [0, 0.006]) for name, mask in inside.items()}
    error = summarize(compute_errors(nodes, displaced(nodes, errors_m)), MEASURED_M)
    count = sum(int((~mask).sum()) for mask in inside.values())
    assert error.outside_count == count > 500
    assert error.outside_mean_m == pytest.approx(0.006)
    assert error.mean_m == pytest.approx((0.006 * count + 0.001 * (error.count - count)) / error.count)


def test_nodes_without_a_position_are_counted_and_left_out(nodes: list[KnownSightings]) -> None:
    errors_m = {seen.camera: np.full((len(seen.truth_m), 2), 0.001) for seen in nodes}
    errors_m["red"] = np.full_like(errors_m["red"], np.nan)
    error = summarize(compute_errors(nodes, displaced(nodes, errors_m)), MEASURED_M)
    assert error.missing == len(errors_m["red"])
    assert error.mean_m == pytest.approx(0.001 * np.sqrt(2))
    nowhere = {name: np.full_like(values, np.nan) for name, values in errors_m.items()}
    with pytest.raises(IpsysError, match="no camera gives a position"):
        summarize(compute_errors(nodes, displaced(nodes, nowhere)), MEASURED_M)


def test_alignment_has_the_least_sum_of_squares() -> None:
    rng = np.random.default_rng(0)
    targets_m = rng.uniform(0, 5, (40, 2))
    turn, shift_m = np.array([[np.cos(2.5), -np.sin(2.5)], [np.sin(2.5), np.cos(2.5)]]), np.array([1.0, -2.0])
    points_m = targets_m @ turn.T + shift_m + rng.normal(0, 0.05, targets_m.shape)

    def cost(values: Array) -> float:
        cos, sin = np.cos(values[0]), np.sin(values[0])
        moved = points_m @ np.array([[cos, sin], [-sin, cos]]) + values[1:]
        return float(((moved - targets_m) ** 2).sum())

    least = min(minimize(cost, [start, 0, 0], tol=1e-12).fun for start in (-2.0, 0.0, 2.0))
    assert ((align_rigidly(points_m, targets_m) - targets_m) ** 2).sum() == pytest.approx(least, rel=1e-6)
    apart = np.linalg.norm(points_m[0] - points_m[1])
    aligned_m = align_rigidly(points_m, targets_m)
    assert np.linalg.norm(aligned_m[0] - aligned_m[1]) == pytest.approx(apart)


@pytest.mark.parametrize("measured_m", [np.zeros((0, 2)), np.zeros((2, 2)), np.arange(8.0).reshape(4, 2)])
def test_points_on_a_line_have_no_hull(measured_m: Array) -> None:
    assert outside_hull(np.array([[1.0, 1.0], [2.0, 3.0]]), measured_m).all()


def test_true_covariances_hold_68_and_95_percent() -> None:
    rng, count = np.random.default_rng(1), 40_000
    roots = 0.002 * rng.normal(size=(count, 2, 2))
    errors_m = (roots @ rng.normal(size=(count, 2, 1)))[..., 0]
    shares = region_shares(errors_m, roots @ roots.swapaxes(1, 2))
    assert shares.inside_68 == pytest.approx(0.68, abs=4 * np.sqrt(0.68 * 0.32 / count))
    assert shares.inside_95 == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / count))
    assert shares.nees == pytest.approx(1.0, abs=4 / np.sqrt(count))


def test_covariances_of_a_locator_are_judged(nodes: list[KnownSightings]) -> None:
    rng = np.random.default_rng(2)
    only = nodes[:1]
    errors_m = {only[0].camera: rng.normal(0, 0.002, only[0].truth_m.shape)}
    covariances_m2 = np.broadcast_to(0.001**2 * np.eye(3), (len(only[0].truth_m), 3, 3))
    shares = summarize(compute_errors(only, displaced(only, errors_m, covariances_m2)), MEASURED_M).shares
    assert shares is not None
    assert shares.nees == pytest.approx(4.0, rel=0.2)
    assert shares.inside_95 < 0.6


@pytest.mark.parametrize("name", ["rayplane", "best"])
def test_models_locate_as_the_stages_do(name: str, lab: GeometricLab, nodes: list[KnownSightings]) -> None:
    messages, stage = list(simulate_session(lab)), CameraFrame()
    points = [
        replace(message, payload=payload)
        for message in messages
        if isinstance(message.payload, (Rig, CameraCalibration, Markers))
        for payload in stage(message)
        if isinstance(payload, CameraPoints)
    ]
    pairs = build_pairs(gather_sightings(points), valid_measurements(messages, None))
    model = fit_model(name, pairs, 0)
    seen = nodes[1]
    some = slice(0, len(seen.truth_m), 97)
    positions_m, covariances_m2 = locate_with_model(model, lab.calibrations, 0.2)(
        seen.camera, seen.corners_px[some], seen.heights_m[some]
    )
    assert covariances_m2 is not None
    locate, rig = LocatePoints(model), next(m for m in messages if isinstance(m.payload, Rig))
    # The locator assumes the usual error of a height.
    list(locate(replace(rig, payload=replace(rig.payload, marker_height_sigma_m=None))))
    for n, corners_px in enumerate(seen.corners_px[some]):
        frame = Markers(0, (Marker(0, corners_px),), 1920, 1080)
        (point,) = stage(Message("", 0, 0, frame, seen.camera))
        (located,) = locate(Message("", 0, 0, point, seen.camera))
        assert isinstance(located, Positions)
        (position,) = located.positions
        assert [position.x_m, position.y_m] == pytest.approx(positions_m[n, :2], abs=1e-9)
        assert position.covariance_m2 == pytest.approx(covariances_m2[n], abs=1e-12)
    # Without a fitted camera, there is no position.
    other = locate_with_model(replace(model, cameras=()), lab.calibrations, 0.2)
    assert np.isnan(other(seen.camera, seen.corners_px[some], seen.heights_m[some])[0]).all()
