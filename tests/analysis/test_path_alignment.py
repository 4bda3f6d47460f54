"""Clock, frames and pivot between tracks and another system, from drives in closed form with known truth."""

from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ipsys_log import IpsysError
from ipsys_log.messages import Array
from ipsys_log.statistics.calibration_points import TimedPoints
from ipsys_log.statistics.ground_truth import TrackedPath
from ipsys_log.statistics.path_alignment import PathAlignment, align_trajectories
from ipsys_log.statistics.trajectories import KnownParts, Trajectory, TrajectoryPair
from ipsys_log.units import NS_PER_S

START_NS = 1_700_000_000 * NS_PER_S
OFFSET_S, PIVOT_M, BODY_TURN_RAD = -3.7, np.array([-0.15, 0.04, 0.0]), 0.6
FRAME = Rotation.from_euler("z", 130, degrees=True)
SHIFT_M = np.array([1.0, -2.0, 0.0])


def drive(times_s: Array) -> tuple[Array, Array]:
    """Return positions (n, 3) and headings (n,) of a robot that turns, stops and turns on the spot."""
    along = 4 * np.sin(times_s / 5) + 0.2 * times_s + 0.4 * np.sin(0.9 * times_s)
    x_m, y_m = 2.5 + 1.5 * np.sin(0.9 * along), 2.0 + 1.2 * np.sin(0.63 * along + 1)
    headings_rad = 0.7 * along + 0.3 * np.sin(1.7 * times_s)
    return np.column_stack([x_m, y_m, np.full(len(times_s), 0.1)]), headings_rad


def straight(times_s: Array) -> tuple[Array, Array]:
    """Return a drive on a line at one speed."""
    return np.column_stack([0.05 * times_s, 1 + 0 * times_s, 0.1 + 0 * times_s]), np.zeros(len(times_s))


def back_and_forth(times_s: Array) -> tuple[Array, Array]:
    """Return a drive on a line with stops: a lever along it looks like a translation."""
    points_m, headings_rad = straight(times_s)
    points_m[:, 0] = 0.02 * times_s + np.sin(times_s**1.2 / 5)
    return points_m, headings_rad


def turned(headings_rad: Array) -> Rotation:
    return Rotation.from_euler("z", headings_rad[:, None])


def make_pair(
    seed: int = 0,
    path: Callable[[Array], tuple[Array, Array]] = drive,
    field_m: float = 0.0,
    length_s: float = 60,
) -> TrajectoryPair:
    """Return a track of 30 Hz with noise of 1 mm and 0.2 degrees, and the exact path of a body of 100 Hz."""
    rng, times_s = np.random.default_rng(seed), np.arange(0, length_s, 1 / 30)
    points_m, headings_rad = path(times_s)
    waves, phases = rng.normal(size=(2, 300, 2)) / 0.5, rng.uniform(0, 2 * np.pi, (2, 300))
    field = np.cos(points_m[:, :2] @ np.swapaxes(waves, 1, 2) + phases[:, None]).sum(axis=2) * np.sqrt(
        2 / 300
    )
    points_m = points_m + rng.normal(0, 1e-3, points_m.shape)
    points_m[:, :2] += field_m * field.T
    positions = TimedPoints(START_NS + np.round(times_s * NS_PER_S).astype(np.int64), points_m)
    track = TrackedPath("ada", positions, headings_rad + rng.normal(0, np.radians(0.2), len(times_s)))
    times_s = np.arange(0, length_s, 0.01)
    points_m, headings_rad = path(times_s)
    own_m = FRAME.inv().apply(points_m + turned(headings_rad).apply(PIVOT_M) - SHIFT_M)
    axes = FRAME.inv() * turned(headings_rad + BODY_TURN_RAD)
    times_ns = START_NS + np.round((times_s - OFFSET_S) * NS_PER_S).astype(np.int64)
    return TrajectoryPair(Trajectory("", times_ns, own_m, axes.as_quat()), track)


def align(pair: TrajectoryPair, **known: object) -> PathAlignment:
    return align_trajectories([pair], KnownParts(**known), "odom.tum")  # type: ignore[arg-type]


def offset_error_s(found: PathAlignment) -> float:
    return found.offset_ns / NS_PER_S - OFFSET_S


def without_axes(pair: TrajectoryPair) -> TrajectoryPair:
    other = replace(pair.other, quaternions=np.full_like(pair.other.quaternions, np.nan))
    return pair._replace(other=other)


@pytest.mark.parametrize("has_axes", [True, False])
@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_clock_pivot_and_frames_lie_within_sigmas(kind: str, has_axes: bool) -> None:
    pair = make_pair()
    found = align(pair if has_axes else without_axes(pair), align=kind)
    assert abs(offset_error_s(found)) < 4 * found.offset_sigma_s < 4e-3
    body = found.bodies[0]
    assert (np.abs(body.pivot_m - PIVOT_M)[:2] < 4 * body.pivot_sigmas_m[:2]).all()
    assert body.pivot_sigmas_m[:2].max() < 2e-3
    if has_axes:
        assert abs(body.turn_rad - BODY_TURN_RAD) < 4 * body.turn_sigma_rad < 0.02
    wrong_rad = (Rotation.from_matrix(found.motion.rotation) * FRAME.inv()).as_rotvec()
    assert abs(wrong_rad[2]) < 4 * found.turn_sigmas_rad[2] < 0.01


@pytest.mark.slow
def test_sigmas_hold_for_errors_that_repeat_with_the_place() -> None:
    normed = []
    for seed in range(12):
        found = align(make_pair(seed, field_m=0.02, length_s=40))
        apart_m, sigmas_m = found.bodies[0].pivot_m - PIVOT_M, found.bodies[0].pivot_sigmas_m
        normed.append([offset_error_s(found) / found.offset_sigma_s, *(apart_m / sigmas_m)[:2]])
    squares = np.mean(np.square(normed), axis=0)
    assert (squares < 2.2).all(), squares
    assert (squares > 0.25).all(), squares


def dead_reckoned(pair: TrajectoryPair) -> TrajectoryPair:
    """Return the path as odometry gives it: 2 % too long, with a heading that drifts."""
    rng, other = np.random.default_rng(7), pair.other
    axes = Rotation.from_quat(other.quaternions)
    steps_m = axes[:-1].inv().apply(np.diff(other.points_m, axis=0)) * 1.02
    walk_rad = np.append(0.0, np.cumsum(rng.normal(0, 2e-3, len(steps_m))))
    axes = turned(walk_rad) * axes
    points_m = np.vstack([np.zeros(3), np.cumsum(axes[:-1].apply(steps_m), axis=0)])
    return pair._replace(other=replace(other, points_m=points_m, quaternions=axes.as_quat()))


def test_drift_of_odometry_pulls_neither_clock_nor_pivot() -> None:
    found = align(dead_reckoned(make_pair()))
    assert abs(offset_error_s(found)) < min(0.005, 4 * found.offset_sigma_s)
    assert np.abs(found.bodies[0].pivot_m - PIVOT_M).max() < 0.02
    assert abs(found.scale - 1 / 1.02) < 4 * found.scale_sigma
    assert "longer than those of the tracks" in " ".join(found.remarks)


def frozen(other: Trajectory) -> Trajectory:
    points_m, quaternions = other.points_m.copy(), other.quaternions.copy()
    points_m[2000:2300], quaternions[2000:2300] = points_m[2000], quaternions[2000]
    return replace(other, points_m=points_m, quaternions=quaternions)


def zeros(other: Trajectory) -> Trajectory:
    points_m = other.points_m.copy()
    points_m[2000:2300] = 0.0
    return replace(other, points_m=points_m)


def jumps(other: Trajectory) -> Trajectory:
    points_m = other.points_m.copy()
    points_m[100::500] += 0.5
    return replace(other, points_m=points_m)


def excursions(other: Trajectory) -> Trajectory:
    points_m = other.points_m.copy()
    for first in (1000, 3000, 5000):
        points_m[first : first + 4] -= 0.7
    return replace(other, points_m=points_m)


def reset(other: Trajectory) -> Trajectory:
    points_m = other.points_m.copy()
    points_m[4500:] += 3.0
    return replace(other, points_m=points_m)


def bursts(other: Trajectory) -> Trajectory:
    """Return stamps that are the time of arrival: the rows wait for the slowest of ten."""
    times_ns = other.times_ns.copy()
    for first in range(0, len(times_ns) - 10, 20):
        times_ns[first : first + 10] = times_ns[first + 9] + 3000 * np.arange(10) - 30_000
    return replace(other, times_ns=times_ns)


@pytest.mark.parametrize(
    ("spoil", "remark"),
    [
        (frozen, "299 poses repeat while the robot moves"),
        (zeros, "299 poses repeat while the robot moves"),
        (jumps, "12 jumps are left out"),
        (excursions, "12 poses after a reset are left out"),
        (reset, "1500 poses after a reset are left out"),
        (bursts, ""),
    ],
)
def test_bad_rows_shift_nothing(spoil: Callable[[Trajectory], Trajectory], remark: str) -> None:
    pair = make_pair()
    found = align(pair._replace(other=spoil(pair.other)))
    assert abs(offset_error_s(found)) < 0.003
    assert np.abs(found.bodies[0].pivot_m - PIVOT_M).max() < 0.005
    assert remark in "; ".join(found.remarks)


def mapped(matrix: list[list[float]]) -> Callable[[TrajectoryPair], TrajectoryPair]:
    def change(pair: TrajectoryPair) -> TrajectoryPair:
        bare = without_axes(pair)
        return bare._replace(other=replace(bare.other, points_m=bare.other.points_m @ np.array(matrix).T))

    return change


def scaled(pair: TrajectoryPair) -> TrajectoryPair:
    bare = without_axes(pair)
    return bare._replace(other=replace(bare.other, points_m=bare.other.points_m / 0.3048))


def rotated(change: Callable[[Array], Array]) -> Callable[[TrajectoryPair], TrajectoryPair]:
    return lambda pair: pair._replace(other=replace(pair.other, quaternions=change(pair.other.quaternions)))


def degrees_as_radians(quaternions: Array) -> Array:
    yaws = np.unwrap(Rotation.from_quat(quaternions).as_euler("ZYX")[:, 0])
    return np.asarray(turned(np.degrees(yaws)).as_quat())


@pytest.mark.parametrize(
    ("change", "axes"),
    [
        (mapped([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), "y up"),
        (mapped([[1, 0, 0], [0, -1, 0], [0, 0, -1]]), "z down"),
    ],
)
def test_axes_of_the_other_system_are_found(
    change: Callable[[TrajectoryPair], TrajectoryPair], axes: str
) -> None:
    pair = make_pair()
    found = align(change(pair))
    assert found.axes == axes
    assert abs(offset_error_s(found)) < 0.003
    lab = found.poses[0]
    expected_m, headings_rad = drive((lab.times_ns - START_NS) / NS_PER_S)
    expected_m += turned(headings_rad).apply(PIVOT_M)
    np.testing.assert_allclose(lab.points_m[:, :2], expected_m[:, :2], atol=5e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (mapped([[1, 0, 0], [0, 0, 1], [0, 1, 0]]), "is mirrored"),
        (scaled, "its lengths are 3.28. times those of the tracks"),
        (rotated(degrees_as_radians), "do if they are degrees, not radians"),
        (rotated(lambda q: np.roll(q, 1, axis=1)), "do if the quaternion is w x y z, not x y z w"),
        (rotated(lambda q: q * [-1, -1, -1, 1]), "do if the rotations are inverted"),
        (lambda _: make_pair(path=straight), "too little motion to determine clock"),
        (lambda _: without_axes(make_pair(path=straight)), "too little motion to determine clock"),
    ],
)
def test_wrong_conventions_and_poor_motion_are_named(
    change: Callable[[TrajectoryPair], TrajectoryPair], message: str
) -> None:
    with pytest.raises(IpsysError, match=message):
        align(change(make_pair()))


def test_pivot_that_the_drive_does_not_determine_is_named() -> None:
    found = align(make_pair(path=back_and_forth))
    assert abs(offset_error_s(found)) < 4 * found.offset_sigma_s < 0.01
    assert "the pivot is not determined" in " ".join(found.remarks)
    assert not found.bodies[0].pivot_m.any()


def test_given_parts_stay_as_they_are() -> None:
    found = align(make_pair(), offset_ns=round(OFFSET_S * NS_PER_S), pivot_m=tuple(PIVOT_M.tolist()))
    assert offset_error_s(found) == 0.0
    assert np.isnan(found.offset_sigma_s)
    np.testing.assert_array_equal(found.bodies[0].pivot_m, PIVOT_M)


@pytest.mark.parametrize(
    ("scale", "field_m", "remark"),
    [(0.996, 0.0, "its lengths are 0.4 % shorter"), (1.002, 0.0, ""), (1.0, 0.02, "")],
)
def test_scale_of_a_measured_path_is_named_and_stays(scale: float, field_m: float, remark: str) -> None:
    pair = make_pair(field_m=field_m)
    found = align(pair._replace(other=replace(pair.other, points_m=pair.other.points_m * scale)))
    assert abs(1 / found.scale - scale) < 4 * found.scale_sigma
    assert np.linalg.det(found.motion.rotation) == pytest.approx(1.0)
    assert [text.partition(" than")[0] for text in found.remarks] == [remark] * bool(remark)


def test_scale_is_applied_only_if_asked_for() -> None:
    pair = make_pair()
    small = pair._replace(other=replace(pair.other, points_m=pair.other.points_m * 0.4))
    found = align(small, with_scale=True)
    assert found.scale == pytest.approx(2.5, abs=4 * found.scale_sigma)
    assert found.residuals.rmse_2d_m < 0.003


def test_record_has_the_clock_with_its_reference() -> None:
    late = replace(align(make_pair()), drift=3e-5, reference_ns=START_NS - 7_000_000_001)
    texts = late.record_parameters()
    times_ns = START_NS + np.array([0, 50 * NS_PER_S])
    offset, drift, reference = (
        Decimal(texts[name]) for name in ("time_offset_s", "clock_drift", "reference_s")
    )
    for time_ns, lab_ns in zip(times_ns.tolist(), late.lab_times_ns(times_ns).tolist(), strict=True):
        time_s = Decimal(time_ns).scaleb(-9)
        assert float(
            time_s + offset + drift * (time_s - reference) - Decimal(lab_ns).scaleb(-9)
        ) == pytest.approx(0.0, abs=2e-9)
