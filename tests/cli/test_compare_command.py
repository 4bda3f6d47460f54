"""``ipsys compare``: the odometry of a robot, by a closed form, scored against its tracks."""

import json
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import ipsys_log as ipsys_api
from ipsys_log.engine.output import write_log
from ipsys_log.exchange.trajectory_files import TrajectoryFile
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, RIG_TOPIC, Message, Run, Track, Tracks
from ipsys_log.messages.channels import ESTIMATE, RECORD
from ipsys_log.messages.rig_file import load_rig, rig_toml
from ipsys_log.statistics.path_alignment import PathAlignment, align_trajectories
from ipsys_log.statistics.trajectories import Trajectory, TrajectoryPair
from ipsys_log.tools import estimates
from ipsys_log.tools.publish.kept_contents import kept_channels
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys, data_section
from tests.exchange.driven_lab import (
    LAB,
    OtherSystem,
    evo_rmse_m,
    instants_ns,
    path_of,
    tilted,
    tracked,
    write_lab,
)

Array = NDArray[np.float64]

OFFSET_S, PIVOT_M = -3.7, np.array([-0.15, 0.02, 0.0])
ODOM = OtherSystem(round(OFFSET_S * NS_PER_S), 1.1, (0.5, -2.0, 0.15))
SECONDS = 12.0
KNOWN = ("--time-offset", OFFSET_S, "--pivot", ",".join(map(str, PIVOT_M)))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_lab(tmp_path / "lab.mcap", SECONDS)


def body_path(
    log: Path, robot: str = "ada", is_tilted: bool = False
) -> tuple[NDArray[np.int64], Array, Rotation]:
    """Return times, points and rotations of a body behind the marker of a robot, in the lab."""
    with ipsys_api.open(log) as opened:
        table = opened.table("tracks")
    rows = table[table["robot"] == robot]
    headings_rad, times_ns = rows["heading_rad"].to_numpy(), np.asarray(rows["time"].astype(np.int64))
    turns = tilted(headings_rad, times_ns) if is_tilted else Rotation.from_euler("z", headings_rad[:, None])
    return times_ns, rows[["x_m", "y_m", "z_m"]].to_numpy() + turns.apply(PIVOT_M), turns


def odometry(
    log: Path, robot: str = "ada", drift: float = 0.01, is_tilted: bool = False
) -> tuple[NDArray[np.int64], Array, Rotation]:
    """Return the same in the clock and the frame of an odometry, whose x is too long by a share.

    The rotations of a tilted body have errors about all axes.
    """
    times_ns, points_m, turns = body_path(log, robot, is_tilted)
    points_m[:, 0] += drift * (points_m[:, 0] - points_m[0, 0])
    turns *= Rotation.from_rotvec(is_tilted * np.random.default_rng(2).normal(0, 0.02, points_m.shape))
    return ODOM.times_ns(times_ns), ODOM.points_m(points_m), ODOM.lab_from_own.inv() * turns


def write_tum(
    path: Path, log: Path, robot: str = "ada", per_m: float = 1.0, late_s: int = 0, is_tilted: bool = False
) -> Path:
    times_ns, points_m, turns = odometry(log, robot, is_tilted=is_tilted)
    lines = [
        f"{time_ns // NS_PER_S + late_s}.{time_ns % NS_PER_S:09d} " + " ".join(map(repr, [*point, *turn]))
        for time_ns, point, turn in zip(
            times_ns.tolist(), (per_m * points_m).tolist(), turns.as_quat().tolist(), strict=True
        )
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def compared(ipsys: Ipsys, *arguments: object) -> list[dict[str, Any]]:
    done = ipsys("compare", *arguments, "--json")
    assert done.code == 0, done.err
    return list(json.loads(done.out)["comparisons"])


@pytest.mark.parametrize("is_tilted", [False, True])
def test_errors_of_an_odometry_are_those_of_evo(tmp_path: Path, ipsys: Ipsys, is_tilted: bool) -> None:
    log = write_lab(tmp_path / "lab.mcap", SECONDS, is_tilted=is_tilted)
    [found] = compared(ipsys, log, write_tum(tmp_path / "odom.tum", log, is_tilted=is_tilted), *KNOWN)
    body_turn = Rotation.from_rotvec([0, 0, found["body_turn_rad"]])
    truth, own = (
        PosePath3D(positions_xyz=points_m, orientations_quat_wxyz=(turns * turn).as_quat(scalar_first=True))
        for (_, points_m, turns), turn in (
            (body_path(log, is_tilted=is_tilted), body_turn),
            (odometry(log, is_tilted=is_tilted), Rotation.identity()),
        )
    )
    turn_key = "rotation_rmse_rad" if is_tilted else "heading_rmse_rad"
    relative = metrics.RPE(ANGLE, 30, Unit.frames, all_pairs=True)
    relative.process_data((truth, own))
    assert found["rpe"][1][turn_key] == pytest.approx(relative.get_statistic(RMSE), abs=1e-6)
    for kind in ("none", "first_pose", "se3"):
        if kind == "first_pose":
            own.align_origin(truth)
        elif kind == "se3":
            own.align(truth)
        absolute = metrics.APE(metrics.PoseRelation.translation_part)
        absolute.process_data((truth, own))
        assert found["ate"][kind]["3d"]["rmse_m"] == pytest.approx(absolute.get_statistic(RMSE), abs=1e-6)
    turned = metrics.APE(ANGLE)
    turned.process_data((truth, own))
    assert found["ate"]["se3"][turn_key] == pytest.approx(turned.get_statistic(RMSE), abs=1e-6)
    assert found["ate_m"] == found["ate"]["yaw"]["3d"]["rmse_m"]
    assert 0.0 < found["drift_share"] < (0.03 if is_tilted else 0.01)
    assert compared(ipsys, log) == [found]


def test_trimmed_export_has_the_errors_of_the_comparison(log: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    # Half of the stamps lie between those of the tracks, and the estimate begins before them.
    file = write_tum(tmp_path / "odom.tum", log)
    lines = file.read_text().splitlines()
    early = [f"{Decimal(line.split()[0]) - Decimal('0.011')} {line.partition(' ')[2]}" for line in lines[::2]]
    file.write_text("\n".join(line for pair in zip(early, lines[1::2], strict=True) for line in pair))
    [found] = compared(ipsys, log, file, *KNOWN, "--scale")
    done = ipsys("export", log, "-o", tmp_path / "a.tum", "--table", "estimate", "--trim")
    assert "a.tum written: 359 poses of estimate" in done.out, done
    for alignment, options in {
        "none": (),
        "first_pose": ("--align_origin",),
        "se3": ("--align",),
        "sim3": ("--align", "--correct_scale"),
    }.items():
        ate_m = evo_rmse_m(tmp_path / "a_truth.tum", tmp_path / "a.tum", *options)
        assert found["ate"][alignment]["3d"]["rmse_m"] == pytest.approx(ate_m, abs=1e-6), alignment


RMSE, ANGLE = metrics.StatisticsType.rmse, metrics.PoseRelation.rotation_angle_rad


def test_comparison_stays_in_the_log(log: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    file, before = write_tum(tmp_path / "odom.tum", log), data_section(log)
    remarks = [one.text for one in ipsys_api.check(log)[0].remarks]
    given = (log, file, "--robot", "ada")
    [found] = compared(ipsys, *given)
    assert data_section(log)[: len(before)] == before
    assert (found["run"], found["tracks_run"], found["robot"]) == ("odom", "poly", "ada")
    assert found["time_offset_s"] == pytest.approx(OFFSET_S, abs=0.02)
    assert [found["pivot_x_m"], found["pivot_y_m"]] == pytest.approx(PIVOT_M[:2], abs=0.02)
    assert [found] == compared(ipsys, log) == compared(ipsys, *given)
    [scaled] = compared(ipsys, *given, "--scale")
    assert scaled["run"] == "odom_2"
    assert scaled["ate_m"] == scaled["ate"]["sim3"]["3d"]["rmse_m"] < found["ate_m"]
    assert compared(ipsys, log) == [found, scaled]
    topic = ESTIMATE.topic_of("odom")
    with Session([log]) as session:
        assert session.count(topic) == 360
        assert topic in kept_channels(session, without_images=False)
    with ipsys_api.open(log) as opened:
        tables = opened.compare()
        assert tables.estimates["ate_m"].tolist()[0] == found["ate_m"]
        assert len(tables.errors) == 6 + 7
        assert [one.text for one in opened.check()[0].remarks] == remarks
    assert ipsys("report", log, "--html", tmp_path / "lab.html").code == 0
    page = (tmp_path / "lab.html").read_text()
    assert "odom.tum: estimate of ada, against its tracks of run poly (the ground truth)" in page
    assert "odom.tum (run odom_2): estimate of ada" in page
    assert "<li>Scale, applied: 0.99" in page
    assert ipsys("cut", log, "-o", tmp_path / "cut.mcap", "--start", 4).code == 0
    first, _ = compared(ipsys, tmp_path / "cut.mcap")
    assert first["ate"]["none"]["3d"]["count"] < found["ate"]["none"]["3d"]["count"]
    assert first["pivot_x_m"] == found["pivot_x_m"]


def test_covariances_are_those_of_the_frame_of_the_odometry(
    log: Path, tmp_path: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    times_ns, points_m, turns = odometry(log, drift=0.0)
    sigmas_m = np.array([0.02, 0.005, 0.0])
    points_m[1:] += np.random.default_rng(1).normal(0, sigmas_m, (len(points_m) - 1, 3))
    covariances = np.tile(np.diag([*sigmas_m**2, 1.0, 1.0, 1e-12]), (len(points_m), 1, 1))
    covariances[0] *= 1e-9
    body = Trajectory("", times_ns, points_m, turns.as_quat(), covariances)
    file = write_tum(tmp_path / "odom.tum", log)
    read = TrajectoryFile(file, (body,), ("", ""))
    monkeypatch.setattr(estimates, "read_trajectories", lambda *_: read)
    [found] = compared(ipsys, log, file, *KNOWN, "--robot", "ada")
    assert found["nees"] == pytest.approx(1.0, abs=0.2)
    assert compared(ipsys, log) == [found]


def test_robots_of_a_table_and_of_another_log_are_known(log: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    noisy = write_lab(tmp_path / "noisy.mcap", SECONDS, noise_m=0.01)
    with ipsys_api.open(noisy) as opened:
        opened.export(tmp_path / "both.csv")
    text = (tmp_path / "both.csv").read_text()
    others = [line.replace(",bob,", ",wand,") for line in text.splitlines() if ",bob," in line]
    (tmp_path / "both.csv").write_text(text + "\n".join(others))  # a body that is no robot is left out
    found = compared(ipsys, log, tmp_path / "both.csv")
    assert [(one["run"], one["robot"]) for one in found] == [("both", "ada"), ("both_2", "bob")]
    for one in found:
        assert one["ate_m"] == pytest.approx(0.01 * np.sqrt(2), rel=0.1)
    output, plot = tmp_path / "results.mcap", tmp_path / "bob.png"
    done = ipsys("compare", log, noisy, "--robot", "bob", "-o", output, "--plot", plot)
    assert f"run noisy written to {output}" in done.err
    assert plot.stat().st_size > 10_000
    assert max(map(len, done.out.splitlines())) <= 80
    assert "noisy.mcap: estimate of bob, against its tracks of run poly (the ground truth)" in done.out
    assert "noisy_2" not in done.err


def test_robot_is_guessed_by_one_fit_if_motion_tells(
    log: Path, tmp_path: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted = []

    def fit(pairs: Sequence[TrajectoryPair], *rest: Any) -> PathAlignment:
        fitted.append(pairs[0].track.robot)
        return align_trajectories(pairs, *rest)

    monkeypatch.setattr(estimates, "align_trajectories", fit)
    [found] = compared(ipsys, log, write_tum(tmp_path / "odom.tum", log, "bob"))
    assert (found["robot"], fitted) == ("bob", ["bob"])


def test_robots_that_drive_alike_are_not_guessed(tmp_path: Path, ipsys: Ipsys) -> None:
    times_ns = instants_ns(SECONDS)
    points_m = path_of(0)((times_ns - times_ns[0]) / NS_PER_S)
    write_log(tmp_path / "lab.mcap", tracked(times_ns, {"ada": points_m, "bob": points_m + 0.5}))
    done = ipsys("compare", tmp_path / "lab.mcap", write_tum(tmp_path / "odom.tum", tmp_path / "lab.mcap"))
    assert "fits the tracks of ada, bob in run poly; name its robot with --robot NAME" in done.err


@pytest.mark.parametrize(
    ("options", "file", "message"),
    [
        ((), {}, "noth.tum: does not exist"),
        (("--robot", "eve"), {"late_s": 0}, "--robot eve: has no track in run poly; it has ada, bob"),
        (("--run", "best"), {"late_s": 0}, "run best has no tracks (they are in: poly)"),
        (("--pivot", "1,2"), {"late_s": 0}, "--pivot 1,2: is not x,y,z in m"),
        (("--align", "4d"), {"late_s": 0}, "--align 4d: is not known; use one of 2d, 3d, none"),
        (("--time-offset", "50", "--align", "none"), {"late_s": 0}, "--time-offset"),
        (("--robot", "bob"), {"late_s": 0}, "odom.tum: "),
        ((), {"per_m": 1000.0}, "odom.tum: "),
        (("--robot", "ada", "--robot", "bob"), {"late_s": 0}, "--robot bob: no estimate is left for it"),
        (("--robot", "ada=/odom"), {"late_s": 0}, "--robot ada=/odom: no file has this body"),
    ],
)
def test_wrong_estimate_is_one_line_and_changes_nothing(
    options: tuple[str, ...], file: dict[str, Any], message: str, log: Path, tmp_path: Path, ipsys: Ipsys
) -> None:
    path = write_tum(tmp_path / "odom.tum", log, **file) if file else tmp_path / "noth.tum"
    before = log.read_bytes()
    done = ipsys("compare", log, path, *options)
    assert done.code == 1
    error = done.err.splitlines()[-1]
    assert message in error, error
    assert log.read_bytes() == before


def test_pivot_is_written_into_the_rig_and_keeps_its_comments(
    log: Path, tmp_path: Path, ipsys: Ipsys
) -> None:
    estimate, path = write_tum(tmp_path / "odom.tum", log), tmp_path / "lab.toml"
    path.write_text("# our lab\n" + rig_toml(LAB))
    given = ("compare", log, estimate, "--robot", "ada", "--write", path)
    assert ipsys(*given).code == 0
    (body,) = load_rig(path).bodies
    assert (body.robot, body.level) == ("ada", LAB.marker_height_m is not None)
    assert body.pivot_m[:2] == pytest.approx(PIVOT_M[:2], abs=0.02)
    assert path.read_text().startswith("# our lab")
    # The tracks of the log are those of the marker, and not of this pivot.
    again = ipsys(*given)
    assert again.code == 1
    assert "the tracks of ada have another pivot than the rig" in again.err
    path.write_text(rig_toml(replace(LAB, markers=())))
    assert "the rig has no robot ada" in ipsys(*given).err


def test_log_without_tracks_or_comparisons_says_so(log: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    assert "has no comparison; name a file with an estimate" in ipsys("compare", log).err
    path = write_tum(tmp_path / "odom.tum", log)
    write_log(tmp_path / "new.mcap", [Message(RIG_TOPIC, 1, 1, LAB)])
    assert "has no tracks; compute them: ipsys replay" in ipsys("compare", tmp_path / "new.mcap", path).err


@pytest.mark.parametrize(
    ("value", "message"),
    [("x" * 99, "pivot_x_m is 'xxx"), ("nan", "a value that is not finite"), ("1", "no track of eve")],
)
def test_comparison_of_a_hostile_log_is_one_line(
    value: str, message: str, tmp_path: Path, ipsys: Ipsys
) -> None:
    times_ns = instants_ns(1.0)
    robot = "eve" if value == "1" else "ada"
    parameters = {"robot": robot, "file": "odom.tum", "align": "2d", "pivot_x_m": value}
    messages = [
        *tracked(times_ns, {"ada": np.column_stack([times_ns - times_ns[0]] * 3) / NS_PER_S}),
        Message(ESTIMATE.topic_of("odom"), 1, 1, Tracks(1, (Track(robot, 0, 0.0, 0.0, 0.0),))),
        Message(RECORD.topic_of("odom"), 1, 1, Run(1, "odom", IMPORTED, parameters)),
    ]
    write_log(tmp_path / "hostile.mcap", messages)
    done = ipsys("compare", tmp_path / "hostile.mcap")
    assert done.code == 1
    [line] = done.err.splitlines()
    assert message in line
