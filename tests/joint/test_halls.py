"""Joint calibration of halls: many cameras, one drive, and few taped points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.calibration.joint import fit as joint_fit
from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.calibration.joint.moved_cameras import find_motion, sum_squares
from ipsys_log.calibration.joint.normal import Factorisation, NormalEquations
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.calibration.joint.parameters import State
from ipsys_log.calibration.joint.problem import Problem
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.solver import Solution, anchor, solve
from ipsys_log.calibration.joint.start import place_cameras
from ipsys_log.capture.simulation.settings import hall_settings
from ipsys_log.messages import Markers, Measurement, Rig
from tests.geometric.floor_error import grid_nodes
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.points import choose_points
from tests.geometric.session import simulate_session

Array = NDArray[np.float64]


def hall_lab(drive_s: float, robots: int) -> GeometricLab:
    """Return a hall of nine cameras; only the cameras of one corner see the eight taped points well."""
    hall = hall_settings(3, 3, seed=5, markers=robots, rate_hz=10.0, drive_s=drive_s)
    lab = build_lab(GeometricSettings(lab=hall, points=8, clock_offset_s=0.02))
    return replace(lab, points=choose_points(hall, lab.cameras[:1], 8))


def observe(lab: GeometricLab) -> Observations:
    messages = list(simulate_session(lab))
    payloads = [message.payload for message in messages]
    rig = next(payload for payload in payloads if isinstance(payload, Rig))
    measured = [payload for payload in payloads if isinstance(payload, Measurement)]
    markers = {
        name: [m.payload for m in messages if isinstance(m.payload, Markers) and m.camera == name]
        for name in lab.calibrations
    }
    return gather_observations(rig, lab.calibrations, markers, measured)


def origin_errors_m(lab: GeometricLab, observations: Observations, origins_m: list[Array]) -> Array:
    true_m = [lab.camera(camera.name).origin_m for camera in observations.cameras]
    return np.asarray(np.linalg.norm(np.array(origins_m) - true_m, axis=1))


@pytest.fixture(scope="module")
def started() -> tuple[GeometricLab, Observations, Problem, State]:
    """A hall before its fit."""
    lab = hall_lab(drive_s=15.0, robots=3)
    observations = observe(lab)
    placed = place_cameras(observations)
    return lab, observations, *joint_fit._build(observations, JointSettings(), placed)


def whole_matrix(normal: NormalEquations) -> Array:
    """Return the normal equations of all unknowns, global ones first, as one dense matrix."""
    local, size = normal.band.shape[1], len(normal.dense)
    matrix = np.zeros((size + local, size + local))
    matrix[:size, :size] = normal.dense
    matrix[size:, :size], matrix[:size, size:] = normal.mixed, normal.mixed.T
    for below, diagonal in enumerate(normal.band):
        rows = np.arange(local - below)
        matrix[size + rows + below, size + rows] = matrix[size + rows, size + rows + below] = diagonal[rows]
    return matrix


def test_cameras_without_points_are_placed_by_the_drive(
    started: tuple[GeometricLab, Observations, Problem, State],
) -> None:
    lab, observations, _, _ = started
    seen = [int((sightings.point >= 0).sum()) for sightings in observations.sightings]
    assert sum(count == 0 for count in seen) >= 3
    placed = place_cameras(observations)
    assert origin_errors_m(lab, observations, [one.origin_m for one in placed]).max() < 0.15


def test_blocks_give_the_solution_of_the_whole_matrix(
    started: tuple[GeometricLab, Observations, Problem, State],
) -> None:
    """The step and the covariance equal those of a dense solver, without any elimination."""
    _, _, problem, state = started
    assert len(problem.blocks) > 3
    normal = problem.linearise(state, 100.0)
    factors = Factorisation(normal, problem.layout.free, 1e-3)
    by_global, by_local = factors.step(normal)
    free = np.concatenate([problem.layout.free, np.ones(len(by_local), dtype=bool)])
    matrix = whole_matrix(problem_without_blocks(problem).linearise(state, 100.0))[np.ix_(free, free)]
    undamped = matrix.copy()
    count = int(problem.layout.free.sum())
    # Damping scales the diagonal of the local part, and that of the reduced global part.
    local = np.arange(count, len(matrix))
    matrix[local, local] *= 1 + 1e-3
    reduced = matrix[:count, :count] - matrix[:count, count:] @ np.linalg.solve(
        matrix[count:, count:], matrix[count:, :count]
    )
    matrix[np.arange(count), np.arange(count)] += 1e-3 * reduced.diagonal()
    gradient = np.concatenate([normal.global_gradient, normal.local_gradient])[free]
    units = 1 / np.sqrt(matrix.diagonal())
    step = -np.linalg.solve(matrix * units[:, None] * units, gradient * units)
    ours = np.concatenate([by_global, by_local])[free] / units
    assert np.abs(ours - step).max() < 1e-6 * np.abs(step).max()
    covariance = Factorisation(normal, problem.layout.free).global_covariance()
    units = 1 / np.sqrt(undamped.diagonal())
    inverse = np.linalg.inv(undamped * units[:, None] * units)[:count, :count]
    scale = np.sqrt(inverse.diagonal())
    own = covariance[np.ix_(problem.layout.free, problem.layout.free)] / np.outer(
        units[:count], units[:count]
    )
    assert np.abs((own - inverse) / np.outer(scale, scale)).max() < 1e-4


def problem_without_blocks(problem: Problem) -> Problem:
    return replace(problem, blocks=())


def test_blocks_give_the_same_uncertainty_of_points(
    started: tuple[GeometricLab, Observations, Problem, State],
) -> None:
    _, observations, problem, state = started
    both = [
        Factorisation(one.linearise(state, 100.0), problem.layout.free)
        for one in (problem, problem_without_blocks(problem))
    ]
    size = 6 * len(observations.points)
    (slopes, own), (dense_slopes, dense_own) = (one.local_from_global(0, size) for one in both)
    assert np.abs(slopes - dense_slopes).max() < 1e-9 * np.abs(dense_slopes).max()
    assert np.abs(own - dense_own).max() < 1e-9 * np.abs(dense_own).max()


def carry(problem: Problem, state: State, angle: float, shift_m: Array) -> State:
    """Return the state of a hall that is turned about the origin and shifted as a whole."""
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    values = state.values.copy()
    for block in problem.layout.cameras:
        origin = slice(block.start + 3, block.start + 6)
        values[origin] = turn @ values[origin] + shift_m
    knots = state.knots.copy()
    knots[:, :2] = knots[:, :2] @ turn[:2, :2].T + shift_m[:2]
    knots[:, 2] += angle
    return replace(
        state,
        values=values,
        camera_turns=state.camera_turns @ turn.T,
        positions_m=state.positions_m @ turn.T + shift_m,
        turns=turn @ state.turns,
        knots=knots,
    )


def test_anchor_moves_a_hall_back_to_its_points(
    started: tuple[GeometricLab, Observations, Problem, State],
) -> None:
    """A hall that was moved as a whole returns, and its cameras keep their places to each other."""
    _, _, problem, state = started
    home = anchor(problem, state)
    away = carry(problem, home, 0.3, np.array([4.0, -2.0, 0.0]))
    for factors in problem.sightings:
        apart = factors.residuals(away, problem.layout, problem.trajectories)
        assert np.allclose(apart, factors.residuals(home, problem.layout, problem.trajectories), atol=1e-4)
    back = anchor(problem, away)
    assert np.abs(back.positions_m - home.positions_m).max() < 1e-3
    assert np.abs(back.values - home.values).max() < 1e-3
    assert np.abs(back.knots - home.knots).max() < 1e-3


@pytest.mark.slow
def test_fit_of_a_turned_hall_returns_to_its_points(
    started: tuple[GeometricLab, Observations, Problem, State],
) -> None:
    """Without an exact motion of the whole hall, the fit takes all readings of the tape for outliers."""
    _, _, problem, state = started
    near = solve(problem, state, short=0.3, patient=True)
    turned = carry(problem, near.state, 0.05, np.array([0.3, 0.2, 0.0]))
    far = solve(problem, turned, short=0.3, patient=True)
    assert far.cost == pytest.approx(near.cost, rel=1e-4)


@pytest.mark.slow
def test_fit_with_an_unusual_reading_leaves_the_easy_stage(
    started: tuple[GeometricLab, Observations, Problem, State], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motion of the whole hall gives an unusual reading less weight than the steps: they undo it."""
    _, observations, _, _ = started
    point = observations.points[0]
    longer = replace(point, distances_m=point.distances_m + np.array([0.02, 0.0]))
    changed = replace(observations, points=(longer, *observations.points[1:]))
    problem, state = joint_fit._build(changed, JointSettings(), place_cameras(changed))
    monkeypatch.setattr("ipsys_log.calibration.joint.solver._MOST_EASY_STEPS", 10)
    assert solve(problem, state, short=0.3, patient=True).steps > 10


def test_blocks_give_the_same_motions_of_cameras(
    started: tuple[GeometricLab, Observations, Problem, State], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An honest hall has no evidence of a motion; the motions with most of it are compared."""
    for limit in ("_CONTRADICTED", "_CONTRADICTED_BY_FEW"):
        monkeypatch.setattr(f"ipsys_log.calibration.joint.moved_cameras.{limit}", 1.0)
    _, observations, problem, state = started
    motions = []
    for one in (problem, problem_without_blocks(problem)):
        normal = one.linearise(state, 1.0)
        solution = Solution(one, state, normal.cost, 1)
        fit = JointFit(observations, JointSettings(), one, solution, np.zeros((0, 0)))
        squares = sum_squares(fit)
        found = [find_motion(squares, camera) for camera in range(len(observations.cameras))]
        motions.append([motion for motion in found if motion is not None])
    ours, dense = motions
    assert len(dense) > 5
    assert [one.camera for one in ours] == [one.camera for one in dense]
    assert [one.time_s for one in ours] == [one.time_s for one in dense]
    assert [one.chi2 for one in ours] == pytest.approx([one.chi2 for one in dense], rel=1e-6)


def floor_errors_m(lab: GeometricLab, fit: JointFit) -> Array:
    """Return the errors of noise-free markers on a grid over the whole floor, of all cameras."""
    settings, models = lab.settings.lab, build_models(fit)

    def place(poses: Array, side_m: float) -> Array:
        return lab.place(poses).corners_m(side_m)

    size = settings.floor_m, settings.drive_height_m, settings.marker_length_m
    errors_m = []
    for camera in lab.cameras:
        nodes = grid_nodes(camera.lens, camera.camera_from_world, place, *size)
        some = slice(None, None, 13)
        corners_px, heights_m = nodes.corners_px[some], nodes.heights_m[some]
        covariances = np.broadcast_to(0.01**2 * np.eye(8), (len(corners_px), 8, 8))
        lengths_m = np.full(len(corners_px), settings.marker_length_m)
        located = locate_markers(models[camera.name], corners_px, covariances, heights_m, lengths_m, 0.0)
        errors_m.append(np.linalg.norm(located.points_m[:, :2] - nodes.truth_m[some], axis=1))
    return np.concatenate(errors_m)


@pytest.mark.slow
def test_hall_is_calibrated_from_one_drive_and_eight_points() -> None:
    """Nine cameras above 10 x 11 m; the eight points are in the field of view of one corner camera.

    The tape was compared with another instrument: its usual scale of 0.1 % is 5 mm at the far cameras.
    """
    lab = hall_lab(drive_s=30.0, robots=5)
    observations = observe(lab)
    compared = replace(observations.tape, scale_sigma=1e-5, references_sigma=1e-5)
    observations = replace(observations, tape=compared)
    fit = fit_jointly(observations)
    blocks = fit.problem.layout.cameras
    origins_m = [fit.state.values[block.start + 3 : block.start + 6] for block in blocks]
    assert origin_errors_m(lab, observations, origins_m).max() < 0.01
    assert floor_errors_m(lab, fit).mean() < 0.002
