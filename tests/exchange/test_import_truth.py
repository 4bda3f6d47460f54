"""Ground truth of another system comes into the clock and the coordinates of the lab."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ipsys_log as ipsys_api
from ipsys_log import IpsysError
from ipsys_log.exchange.import_truth import ImportedTruth, TruthOptions, import_truth
from ipsys_log.log.dataset import Session
from ipsys_log.messages import TRUTH_TOPIC, Run, Track, Tracks
from ipsys_log.messages.channels import TRACKS
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys, data_section
from tests.exchange.driven_lab import LAB, ROBOTS, START_NS, OtherSystem, instants_ns, path_of, write_lab

_SAME = OtherSystem(0, 0.0, (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def exact_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lab(tmp_path_factory.mktemp("exact") / "lab.mcap")


@pytest.fixture
def log(exact_log: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(exact_log, tmp_path / "lab.mcap"))


def stored(log: Path) -> list[Tracks]:
    with Session([log]) as session:
        return list(session.payloads([TRUTH_TOPIC]))


def tracks_of(log: Path) -> list[Tracks]:
    with Session([log]) as session:
        return list(session.payloads(session.topics(TRACKS, "poly")))


def rows(frames: list[Tracks]) -> list[tuple[int, str, int, float, float, float]]:
    return [
        (frame.timestamp, track.robot, track.id, track.x_m, track.y_m, track.z_m)
        for frame in frames
        for track in frame.tracks
    ]


def headings_rad(frames: list[Tracks]) -> list[float | None]:
    return [track.heading_rad for frame in frames for track in frame.tracks]


def write_tum(path: Path, log: Path, robot: str, system: OtherSystem) -> Path:
    """Write the exported trajectory of a robot in the clock and coordinates of another system."""
    with ipsys_api.open(log) as opened:
        opened.export(path, robot=robot)
    times, *_ = zip(*(line.split() for line in path.read_text().splitlines()), strict=True)
    whole = np.array([int(text.replace(".", "")) for text in times])
    values = np.loadtxt(path)
    points_m = system.points_m(values[:, 1:4])
    turns = system.lab_from_own.inv() * type(system.lab_from_own).from_quat(values[:, 4:])
    lines = []
    for ns, point, turn in zip(system.times_ns(whole).tolist(), points_m, turns.as_quat(), strict=True):
        sign, (seconds, rest) = "-" if ns < 0 else "", divmod(abs(ns), NS_PER_S)
        lines.append(f"{sign}{seconds}.{rest:09d} " + " ".join(map(repr, [*point.tolist(), *turn.tolist()])))
    path.write_text("\n".join(lines) + "\n")
    return path


def parameter(record: Run, name: str) -> float:
    return float(record.parameters[name])


def test_exported_table_comes_back_exactly(log: Path, tmp_path: Path) -> None:
    with ipsys_api.open(log) as opened:
        opened.export(tmp_path / "tracks.csv")
    import_truth([tmp_path / "tracks.csv"], log, None, TruthOptions(align="none", time_offset_ns=0))
    assert rows(stored(log)) == rows(tracks_of(log))
    np.testing.assert_allclose(headings_rad(stored(log)), headings_rad(tracks_of(log)), atol=1e-14)  # type: ignore[arg-type]


def test_body_of_a_file_is_selected_and_named(log: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    file = tmp_path / "tracks.csv"
    with ipsys_api.open(log) as opened:
        opened.export(file)
    file.write_text(file.read_text().replace("ada", "Rigid Body 0").replace("bob", "Rigid Body 1"))
    done = ipsys("import", file, "--into", log, "--robot", "ada=Rigid Body 0", "--time-offset", "0")
    assert (done.code, done.out.startswith("Ground truth: 900 poses of ada.")) == (0, True), done.err
    understood = done.err.index("tracks.csv: table; bodies: Rigid Body 0, Rigid Body 1; poses: 900")
    assert understood < done.err.index("position in m") < done.err.index("results are in")


@pytest.mark.slow
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    offset_ns=st.integers(-START_NS, 10**12),
    turn_rad=st.floats(-3.1, 3.1),
    shift_m=st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
)
def test_moved_trajectories_come_back(
    offset_ns: int, turn_rad: float, shift_m: tuple[float, float], exact_log: Path, tmp_path: Path
) -> None:
    log = Path(shutil.copy(exact_log, tmp_path / "lab.mcap"))
    system = OtherSystem(offset_ns, turn_rad, (*shift_m, 0.0))
    files = [write_tum(tmp_path / f"{robot}.tum", log, robot, system) for robot in ROBOTS]
    found = import_truth(files, log, None, TruthOptions(robots=tuple(ROBOTS)))
    # The estimate smooths the other path over 0.1 s, which is exact for a cubic only.
    assert abs(found.time_offset_ns - offset_ns) <= 10_000
    assert found.residuals is not None
    assert found.residuals.rmse_3d_m < 1e-5
    expected, back = rows(tracks_of(log)), rows(stored(log))
    assert [row[1:3] for row in back] == [row[1:3] for row in expected]
    since_ns = [np.array([row[0] for row in part], np.int64) - START_NS for part in (back, expected)]
    np.testing.assert_allclose(since_ns[0], since_ns[1], atol=10_000)
    np.testing.assert_allclose([row[3:] for row in back], [row[3:] for row in expected], atol=1e-5)
    apart_rad = np.subtract(headings_rad(stored(log)), headings_rad(tracks_of(log)))  # type: ignore[arg-type]
    assert np.abs((apart_rad + np.pi) % (2 * np.pi) - np.pi).max() < 1e-5


def noisy_import(folder: Path, align: str, system: OtherSystem, seed: int) -> ImportedTruth:
    """Import a table with other instants, noise of 1 mm and 1 % gross outliers, into noisy tracks."""
    log = write_lab(folder / "lab.mcap", 60.0, 0.006)
    rng, times_ns = np.random.default_rng(seed), instants_ns(80.0, 100.0) - 7 * NS_PER_S
    lines = ["time_ns,robot,x_mm,y_mm,z_mm"]
    for robot, number in ROBOTS.items():
        points_m = path_of(number)((times_ns - START_NS) / NS_PER_S) + rng.normal(
            0, 0.001, (len(times_ns), 3)
        )
        outliers = rng.random(len(times_ns)) < 0.01
        points_m[outliers] += rng.normal(0, 1.0, (outliers.sum(), 3))
        own_mm = system.points_m(points_m) * 1000
        lines += [
            f"{time_ns},{robot},{x:.4f},{y:.4f},{z:.4f}"
            for time_ns, (x, y, z) in zip(system.times_ns(times_ns).tolist(), own_mm.tolist(), strict=True)
        ]
    (folder / "truth.csv").write_text("\n".join(lines))
    return import_truth([folder / "truth.csv"], log, None, TruthOptions(align=align))


@pytest.mark.parametrize("align", ["2d", "3d"])
def test_estimates_lie_within_their_sigmas(align: str, tmp_path: Path) -> None:
    turn_rad = np.array([0.02, -0.03, 2.0]) if align == "3d" else np.array([0.0, 0.0, 2.0])
    system = OtherSystem(-12_345_678_901, turn_rad, (1.5, -2.5, 0.3 if align == "3d" else 0.0))
    found = noisy_import(tmp_path, align, system, seed=3)
    record = found.record
    assert found.alignment is not None
    sigma_s = parameter(record, "time_offset_sigma_s")
    assert 5e-5 < sigma_s < 1e-3
    assert abs(parameter(record, "time_offset_s") + 12.345678901) < 4 * sigma_s
    jumps = re.findall(r"(\d+) jumps are left out", record.parameters["remarks"])
    assert sum(map(int, jumps)) > 20
    wrong = system.lab_from_own.inv().as_matrix() @ found.alignment.motion.rotation
    apart_rad = type(system.lab_from_own).from_matrix(wrong).magnitude()
    sigmas_rad = found.alignment.turn_sigmas_rad
    assert apart_rad < 4 * np.sqrt(np.nansum(sigmas_rad**2)) < 0.01
    for axis in "xyz" if align == "3d" else "xy":
        error_m = parameter(record, f"translation_{axis}_m") - system.shift_m["xyz".index(axis)]
        sigma_m = parameter(record, f"translation_{axis}_sigma_m")
        assert abs(error_m) < 4 * sigma_m < 0.01


def test_import_appends_its_record_and_rewrites_nothing(log: Path, tmp_path: Path) -> None:
    before = data_section(log)
    write_tum(tmp_path / "ada.tum", log, "ada", OtherSystem(5 * NS_PER_S, 1.0, (1.0, 2.0, 0.0)))
    import_truth([tmp_path / "ada.tum"], log, None, TruthOptions(robots=("ada",)))
    assert data_section(log)[: len(before)] == before
    with Session([log]) as session:
        record = session.runs()[-1]
    assert (record.run, record.stage, record.input_runs) == ("truth", "import", ("poly",))
    assert record.parameters["files"] == "ada.tum"
    assert parameter(record, "time_offset_s") == pytest.approx(5.0, abs=1e-6)
    assert parameter(record, "rotation_z_rad") == pytest.approx(1.0, abs=1e-6)
    assert [(one.topic, one.messages) for one in record.outputs] == [(TRUTH_TOPIC, 900)]


def csv_text(*lines: str) -> str:
    return "\n".join(("time_s,robot,x_m,y_m,z_m", *lines))


_MOVING = [f"{n / 10},ada,{n / 50},{(n / 40) ** 2},0.1" for n in range(100)]


@pytest.mark.parametrize(
    ("name", "text", "options", "message"),
    [
        ("a.csv", csv_text("0,eve,1,2,0"), {}, "'eve' is not known; the rig has ada, bob"),
        ("a.csv", csv_text("0,ada,1,two,0"), {}, "'two' is not a number"),
        ("a.csv", "time_s,x_m,y_m,z_m\n0.5,1,2,0", {}, "names no robot; add --robot"),
        ("a.csv", csv_text(*_MOVING), {"time_offset_ns": 0}, "does not overlap in time"),
        ("a.csv", csv_text("0,ada,1,1,0", "9,ada,1,1,0"), {}, "too little motion"),
        ("a.csv", csv_text(*_MOVING), {}, "no time offset and alignment bring both"),
        ("a.csv", csv_text(*_MOVING), {"run": "best"}, "run best has no tracks .they are in: poly"),
        ("a.csv", csv_text(*_MOVING), {"align": "4d"}, "--align 4d: is not known"),
        (
            "a.csv",
            csv_text(*_MOVING),
            {"align": "none", "time_offset_ns": 0, "pivot_m": (0.1, 0.0, 0.0)},
            "--pivot: has no effect",
        ),
    ],
)
def test_wrong_truth_is_refused_and_changes_nothing(
    name: str, text: str, options: dict[str, object], message: str, log: Path, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    before = log.read_bytes()
    with pytest.raises(IpsysError, match=message) as refused:
        import_truth([tmp_path / name], log, None, TruthOptions(**options))  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)
    assert log.read_bytes() == before


def test_second_truth_is_refused(log: Path, tmp_path: Path) -> None:
    file = write_tum(tmp_path / "ada.tum", log, "ada", _SAME)
    options = TruthOptions(robots=("ada",))
    import_truth([file], log, None, options)
    before = log.read_bytes()
    with pytest.raises(IpsysError, match="has ground truth already"):
        import_truth([file], log, None, options)
    assert log.read_bytes() == before


def test_repeated_path_needs_a_time_offset(log: Path, tmp_path: Path) -> None:
    times_ns = instants_ns(40.0)
    lap_s = ((times_ns - START_NS) / NS_PER_S) % 10.0
    lines = [
        f"{time_ns},ada,{2 + np.sin(2 * np.pi * lap / 10):.6f},{3 + np.sin(4 * np.pi * lap / 10):.6f},0.1"
        for time_ns, lap in zip(times_ns.tolist(), lap_s.tolist(), strict=True)
    ]
    text = "\n".join(["time_ns,robot,x_m,y_m,z_m", *lines])
    (tmp_path / "laps.csv").write_text(text)
    other = tmp_path / "laps.mcap"
    import_tracks(other, times_ns, lap_s)
    with pytest.raises(IpsysError, match="the path repeats itself; give --time-offset"):
        import_truth([tmp_path / "laps.csv"], other, None, TruthOptions())
    found = import_truth([tmp_path / "laps.csv"], other, None, TruthOptions(time_offset_ns=0))
    assert found.residuals is not None
    assert found.residuals.rmse_2d_m < 1e-4


def import_tracks(path: Path, times_ns: np.ndarray, lap_s: np.ndarray) -> None:
    from ipsys_log.engine.output import write_log
    from tests.exchange.driven_lab import tracked

    angle = 2 * np.pi * lap_s / 10
    points_m = np.column_stack([2 + np.sin(angle), 3 + np.sin(2 * angle), np.full(len(angle), 0.1)])
    write_log(path, tracked(times_ns, {"ada": points_m}))


def test_log_without_tracks_needs_offset_and_no_alignment(tmp_path: Path, ipsys: Ipsys) -> None:
    (tmp_path / "a.csv").write_text(csv_text(*_MOVING))
    from ipsys_log.messages.rig_file import rig_toml

    (tmp_path / "lab.toml").write_text(rig_toml(LAB))
    arguments = [
        "import",
        "truth",
        tmp_path / "a.csv",
        "-o",
        tmp_path / "new.mcap",
        "--rig",
        tmp_path / "lab.toml",
    ]
    refused = ipsys(*arguments)
    assert refused.code == 1
    assert "give --align none --time-offset S" in refused.err
    assert not (tmp_path / "new.mcap").exists()
    done = ipsys(*arguments, "--align", "none", "--time-offset", "1.5")
    assert done.code == 0
    assert "Time offset: 1.500000 s, added to the times of the file" in done.out
    frames = stored(tmp_path / "new.mcap")
    assert (frames[0].timestamp, len(frames)) == (1_500_000_000, 100)
    assert isinstance(frames[0].tracks[0], Track)
    assert frames[0].tracks[0].heading_rad is None
