"""The trajectory metrics are those of evo, and the tables and the JSON have them."""

import copy
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from evo.core import lie_algebra as lie
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from rich.console import Console
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

import ipsys_log as ipsys
from ipsys_log.app.report.accuracy import Accuracy, accuracy_json, read_accuracy
from ipsys_log.app.report.summary import answer_text
from ipsys_log.app.report.tables import trajectory_table
from ipsys_log.engine.output import append_messages
from ipsys_log.engine.provenance import Outcome
from ipsys_log.log.dataset import Session
from ipsys_log.messages import TRUTH_TOPIC, Array, ErrorStatistics, Message
from ipsys_log.messages.channels import TRACKS
from ipsys_log.models.tracking.track_messages import gather_rows
from ipsys_log.statistics.accuracy import root_mean_square_m
from ipsys_log.statistics.estimate_scores import EstimateFrame, score_estimate
from ipsys_log.statistics.ground_truth import (
    TrackedPath,
    TrajectoryErrors,
    gather_paths,
    pairs_at,
    trajectory_errors,
)
from ipsys_log.units import NS_PER_S
from tests.exchange.driven_lab import ROBOTS, START_NS, instants_ns, path_of, tracked, write_lab

SECONDS = 12.0


def truth_messages(turn: str) -> Iterator[Message]:
    times_ns = instants_ns(SECONDS)
    points_m = {robot: path_of(seed)((times_ns - START_NS) / NS_PER_S) for robot, seed in ROBOTS.items()}
    for message in tracked(times_ns, points_m, False, turn != "positions", turn == "rotations"):
        if message.topic == TRACKS.topic_of("poly"):
            yield Message(TRUTH_TOPIC, message.log_time_ns, message.publish_time_ns, message.payload)


@pytest.fixture(scope="module", params=["headings", "positions", "rotations"])
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("metrics")
    path = write_lab(folder / "lab.mcap", SECONDS, 0.01, is_tilted=request.param == "rotations")
    append_messages(path, truth_messages(request.param))
    return path


def paths_of(log: Path, name: str) -> dict[int, TrackedPath]:
    with Session([log]) as session:
        topics = [TRUTH_TOPIC] if name == "truth" else session.topics(TRACKS, "poly")
        return gather_paths(session.messages(topics))


def errors_of(log: Path) -> list[TrajectoryErrors]:
    return trajectory_errors(paths_of(log, "tracks"), paths_of(log, "truth"))


def evo_paths(log: Path, folder: Path, robot: str) -> tuple[PosePath3D, PosePath3D, bool]:
    """Return truth and track as evo reads exported TUM files; those of tilted bodies from the messages."""
    paths = []
    with ipsys.open(log) as opened:
        for found in (paths_of(log, name) for name in ("truth", "tracks")):
            path = next(one for one in found.values() if one.robot == robot)
            if path.rotations_rad is not None:
                turns = Rotation.from_rotvec(path.rotations_rad).as_quat(scalar_first=True)
                paths.append(PosePath3D(positions_xyz=path.positions.points_m, orientations_quat_wxyz=turns))
        if paths:
            return paths[0], paths[1], True
        has_headings = bool(opened.table("truth")["heading_rad"].notna().all())
        for name in ("truth", "tracks"):
            if has_headings:
                opened.export(folder / f"{name}.tum", name, robot=robot)
                rows = np.loadtxt(folder / f"{name}.tum")
                points_m, turns = rows[:, 1:4], rows[:, [7, 4, 5, 6]]
            else:
                table = opened.table(name)
                points_m = table[table["robot"] == robot][["x_m", "y_m", "z_m"]].to_numpy()
                turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(points_m), 1))
            paths.append(PosePath3D(positions_xyz=points_m, orientations_quat_wxyz=turns))
    return paths[0], paths[1], has_headings


def assert_same(found: ErrorStatistics, metric: metrics.PE) -> None:
    statistics = metric.get_all_statistics()
    assert found.count == len(metric.error) > 50
    for name in ("mean", "median", "max"):
        assert getattr(found, f"{name}_m") == pytest.approx(statistics[name], abs=1e-6), name
    assert root_mean_square_m(found) == pytest.approx(statistics["rmse"], abs=1e-6)
    assert found.std_m == pytest.approx(np.std(metric.error, ddof=1), abs=1e-6)
    assert found.p95_m == pytest.approx(np.percentile(metric.error, 95), abs=1e-6)


def test_trajectory_errors_are_those_of_evo(log: Path, tmp_path: Path) -> None:
    for errors in errors_of(log):
        truth, track, has_headings = evo_paths(log, tmp_path, errors.robot)
        absolute = metrics.APE(metrics.PoseRelation.translation_part)
        absolute.process_data((truth, track))
        assert_same(errors.absolute_3d, absolute)
        relation = (
            metrics.PoseRelation.translation_part if has_headings else metrics.PoseRelation.point_distance
        )
        assert [(one.delta, one.unit) for one in errors.relative] == [(1.0, "m"), (1.0, "s")]
        for one, (delta, unit) in zip(errors.relative, [(1.0, Unit.meters), (30, Unit.frames)], strict=True):
            assert one.relation == relation.value.replace(" ", "_")
            relative = metrics.RPE(
                relation, delta, unit, rel_delta_tol=0.1, all_pairs=True, pairs_from_reference=True
            )
            relative.process_data((truth, track))
            assert_same(one.summary, relative)


def test_scores_of_an_estimate_are_those_of_evo(log: Path, tmp_path: Path) -> None:
    """The tracks are scored as an estimate in its own coordinates and scale, against the ground truth."""
    yaw_rad, shift_m, scale = 2.2, np.array([1.0, -2.0, 0.3]), 1.25
    frame = EstimateFrame(yaw_rad, shift_m, scale, np.zeros(3), 0.0)
    own_from_lab = lie.se3_inverse(lie.se3(Rotation.from_rotvec([0, 0, yaw_rad]).as_matrix(), shift_m))
    with Session([log]) as session:
        estimate, true = (
            gather_rows(session.messages(topics), "ada")[0]
            for topics in (session.topics(TRACKS, "poly"), [TRUTH_TOPIC])
        )
    # Without a movement in z, a mirrored fit would be as good.
    wave_m = np.outer(np.sin(np.arange(len(true.times_ns)) / 10), [0.0, 0.0, 0.1])
    for rows in (estimate, true):
        rows.points_m[:] += wave_m
    paths = [next(iter(paths_of(log, name).values())) for name in ("tracks", "truth")]
    is_tilted = all(path.rotations_rad is not None for path in paths)
    rotations = tuple(path.axes_at(true.times_ns) for path in paths) if is_tilted else None
    score = score_estimate(estimate, true, frame, True, "ada.tum", rotations)  # type: ignore[arg-type]
    truth, lab, has_headings = evo_paths(log, tmp_path, "ada")
    truth, lab = (
        PosePath3D(path.positions_xyz + wave_m, path.orientations_quat_wxyz) for path in (truth, lab)
    )
    lab.transform(own_from_lab)
    lab.scale(1 / scale)
    kinds = ["none", *["first_pose"] * has_headings, "yaw", "se3", "sim3"]
    assert [row.alignment for row in score.aligned] == kinds
    for row in score.aligned:
        own = copy.deepcopy(lab)
        if row.alignment == "yaw":
            assert_least(row.points_m, truth.positions_xyz, own.positions_xyz)
            continue
        if row.alignment == "first_pose":
            own.align_origin(truth)
        elif row.alignment != "none":
            own.align(truth, correct_scale=row.alignment == "sim3")
        assert np.allclose(row.points_m, own.positions_xyz, atol=1e-9), row.alignment
        absolute = metrics.APE(metrics.PoseRelation.translation_part)
        absolute.process_data((truth, own))
        assert_same(row.errors.absolute_3d, absolute)
        if has_headings:
            turned = metrics.APE(metrics.PoseRelation.rotation_angle_rad)
            turned.process_data((truth, own))
            # Level tracks have headings alone, so the tilt of a fit in space is in the rotations of evo only.
            tilt_rad = 1e-4 if row.alignment in ("se3", "sim3") and not is_tilted else 1e-6
            assert np.abs(row.turns_rad) == pytest.approx(turned.error, abs=tilt_rad), row.alignment
    for one, (delta, unit) in zip(score.relative, [(1.0, Unit.meters), (30, Unit.frames)], strict=True):
        relations = {one.relation.replace("_", " "): one.errors_m}
        if one.errors_rad is not None:
            relations["rotation angle in radians"] = one.errors_rad
        for relation, errors in relations.items():
            relative = metrics.RPE(
                metrics.PoseRelation(relation),
                *(delta, unit),
                rel_delta_tol=0.1,
                all_pairs=True,
                pairs_from_reference=True,
            )
            relative.process_data((truth, own))
            assert errors == pytest.approx(relative.error, abs=1e-6), relation


def assert_least(aligned_m: Array, true_m: Array, own_m: Array) -> None:
    """Check the least squares of yaw and translation, which evo lacks, by a search over the yaw."""

    def squares(yaw_rad: float) -> float:
        turned_m = Rotation.from_rotvec([0, 0, yaw_rad]).apply(own_m)
        apart_m = turned_m - true_m
        return float(((apart_m - apart_m.mean(axis=0)) ** 2).sum())

    starts = np.linspace(-np.pi, np.pi, 9)
    least = min(minimize_scalar(squares, bracket=(start, start + 0.1)).fun for start in starts)
    assert ((aligned_m - true_m) ** 2).sum() == pytest.approx(least, rel=1e-9)


def test_api_has_ate_and_rpe_as_evo_computes_them(log: Path, tmp_path: Path) -> None:
    with ipsys.open(log) as opened:
        table = opened.trajectory_errors("poly")
    for robot in ("ada", "bob"):
        truth, track, _ = evo_paths(log, tmp_path, robot)
        metric = metrics.APE(metrics.PoseRelation.translation_part)
        metric.process_data((truth, track))
        own = table[table["robot"] == robot].set_index("metric")
        row = own.loc["ATE 3D"]
        for name in ("rmse", "mean", "median", "max"):
            assert row[f"{name}_m"] == pytest.approx(metric.get_all_statistics()[name], abs=1e-6), name
        assert row["p95_m"] == pytest.approx(np.percentile(metric.error, 95), abs=1e-6)
        assert own[own.index == "RPE"]["delta"].tolist() == ["1 m", "1 s"]


def test_pairs_skip_gaps_and_take_the_start_of_a_stop() -> None:
    start, end = pairs_at(np.array([0.0, 0.5, 1.0, 1.0, 1.0, 4.0, 5.05]), 1.0, 0.1)
    assert list(zip(start.tolist(), end.tolist(), strict=True)) == [(0, 2), (5, 6)]
    assert not len(pairs_at(np.array([0.0]), 1.0, 0.1)[0])


@pytest.fixture(scope="module")
def accuracies(log: Path) -> list[Accuracy]:
    with Session([log]) as session:
        return read_accuracy(session, [Outcome("fuse", "poly", False)])


def test_json_has_ate_and_rpe_of_each_robot(accuracies: list[Accuracy], log: Path) -> None:
    tracks = accuracy_json(accuracies)["models"]["poly"]["tracks"]
    by_robot = {errors.robot: errors for errors in errors_of(log)}
    assert [*tracks["robots"]] == [*by_robot] == ["ada", "bob"]
    for robot, errors in by_robot.items():
        ate = tracks["robots"][robot]["ate"]
        assert ate["3d"]["rmse_m"] == pytest.approx(root_mean_square_m(errors.absolute_3d))
        assert ate["2d"]["count"] == 360
    squares = [tracks["robots"][robot]["ate"]["3d"]["rmse_m"] ** 2 for robot in by_robot]
    assert tracks["ate"]["3d"]["rmse_m"] == pytest.approx(np.sqrt(np.mean(squares)))
    assert tracks["ate"]["3d"]["rmse_m"] == pytest.approx(tracks["truth"]["3d"]["rmse_m"])
    assert [(one["delta"], one["unit"]) for one in tracks["rpe"]] == [(1.0, "m"), (1.0, "s")]
    assert tracks["rpe"][1]["count"] == 2 * 330


def test_table_of_metrics_fits_a_terminal(accuracies: list[Accuracy]) -> None:
    output = io.StringIO()
    console = Console(file=output, width=80)
    console.print(trajectory_table([*accuracies, *accuracies]))
    text = output.getvalue()
    pooled = accuracy_json(accuracies)["models"]["poly"]["tracks"]
    row = next(line for line in text.splitlines() if "(all)" in line)
    assert f"{100 * pooled['ate']['3d']['rmse_m']:.2f}" in row.split()
    assert f"{100 * pooled['rpe'][0]['rmse_m']:.2f}" in row.split()
    assert "…" not in text
    console.print(answer_text(accuracies))
    line = " ".join(output.getvalue().split())
    assert f"(ATE): RMSE {100 * pooled['ate']['3d']['rmse_m']:.2f} cm in 3D" in line
