"""Exported files hold the values of the log, as other programs read them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

import ipsys_log as ipsys
from ipsys_log import IpsysError
from ipsys_log.engine.output import write_log
from ipsys_log.exchange import data_frames
from ipsys_log.messages import Distance, Measurement, Message
from tests.exchange.driven_lab import evo_rmse_m
from tests.sinks.streaming import TILT_RAD, tilted_track, write_tilted


@pytest.fixture(scope="module")
def log(detected_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = Path(shutil.copy(detected_log, tmp_path_factory.mktemp("export") / "lab.mcap"))
    ipsys.replay(path, models=("poly", "rigid"))
    return path


def _small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data_frames, "_BATCH", 7)


@pytest.mark.parametrize("name", ["tracks", "positions", "markers"])
def test_csv_has_the_values_of_the_table(
    name: str, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ipsys.open(log) as opened:
        expected = opened.table(name)
        _small_parts(monkeypatch)
        exported = opened.export(tmp_path / "table.csv", name)
    table = pd.read_csv(tmp_path / "table.csv")
    assert exported.rows == len(table) == len(expected) > 7
    assert list(table) == list(expected)
    assert (pd.to_datetime(table["time"], utc=True) == expected["time"]).all()
    for column in expected.select_dtypes("number"):
        pd.testing.assert_series_equal(
            table[column].astype(float), expected[column].astype(float), check_exact=True
        )
    if "cameras" in expected:
        cameras = table["cameras"].fillna("").str.split()
        assert list(map(set, cameras)) == list(map(set, expected["cameras"]))


@pytest.mark.parametrize("name", ["tracks", "measurements", "events"])
def test_parquet_has_the_values_of_the_table(
    name: str, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = ["poly", "rigid"] if name == "tracks" else None
    with ipsys.open(log) as opened:
        expected = opened.table(name, run=runs)
        _small_parts(monkeypatch)
        exported = opened.export(tmp_path / "table.parquet", name, run=runs)
    table = pq.read_table(tmp_path / "table.parquet")
    assert exported.rows == table.num_rows == len(expected)
    assert table.column_names == list(expected)
    for column, values in table.to_pydict().items():
        read = [json.loads(text) for text in values] if column == "distances_m" else values
        known = expected[column].tolist()
        assert list(map(_comparable, read)) == list(map(_comparable, known)), column


def test_table_of_measurements_names_the_ends_of_a_baseline(tmp_path: Path) -> None:
    reading = Measurement(1, "ab", distances=(Distance("B", 4.0),), from_reference="A")
    write_log(tmp_path / "a.mcap", [Message("/measurements", 1, 1, reading)])
    with ipsys.open(tmp_path / "a.mcap") as opened:
        (row,) = opened.table("measurements").to_dict("records")
    assert (row["from_reference"], row["distances_m"]) == ("A", {"B": 4.0})


def _comparable(value: object) -> object:
    """Return a value with one kind of missing values and of sequences."""
    if isinstance(value, (list, tuple)):
        return list(value)
    return None if not isinstance(value, dict) and pd.isna(value) else value  # type: ignore[call-overload]


def test_evo_finds_the_error_of_the_tracks(log: Path, tmp_path: Path) -> None:
    with ipsys.open(log) as opened:
        exported = opened.export(tmp_path / "track.tum", robot="robot_0", trim=True)
        tracks, truth = (
            table[table["robot"] == "robot_0"].drop_duplicates("time", keep="last")
            for table in (opened.table("tracks"), opened.table("truth"))
        )
    both = tracks.merge(truth, on="time", suffixes=("", "_true"))
    offsets_m = np.array([both[f"{axis}_m"] - both[f"{axis}_m_true"] for axis in "xyz"])
    expected_m = float(np.sqrt((offsets_m**2).sum(axis=0).mean()))
    assert len(both) == exported.rows > 10
    assert evo_rmse_m(tmp_path / "track_truth.tum", tmp_path / "track.tum") == pytest.approx(
        expected_m, abs=1e-6
    )


def test_kitti_rows_are_the_poses_of_tum(log: Path, tmp_path: Path) -> None:
    with ipsys.open(log) as opened:
        for suffix in ("tum", "kitti"):
            opened.export(tmp_path / f"truth.{suffix}", "truth", robot="robot_1")
    tum, kitti = (np.loadtxt(tmp_path / f"truth.{suffix}") for suffix in ("tum", "kitti"))
    matrices = kitti.reshape(-1, 3, 4)
    np.testing.assert_array_equal(matrices[:, :, 3], tum[:, 1:4])
    headings_rad = 2 * np.arctan2(tum[:, 6], tum[:, 7])
    np.testing.assert_allclose(matrices[:, 0, 0], np.cos(headings_rad), atol=1e-12)
    np.testing.assert_allclose(matrices[:, 1, 0], np.sin(headings_rad), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        ("a.tum", {}, "choose one"),
        ("a.tum", {"trim": True}, "needs one robot with tracks .* robot_0, robot_1"),
        ("a.csv", {"trim": True, "robot": "robot_0"}, "--trim needs one run, and a name in .tum"),
        ("a.tum", {"robot": "ada"}, "has no robot 'ada'"),
        ("a.csv", {"robot": "ada"}, "has no robot 'ada'"),
        ("a.tum", {"table": "markers"}, "is no trajectory"),
        ("a.kitti", {"run": ["poly", "rigid"]}, "has one run"),
        ("a.csv", {"table": "markers", "robot": "ada"}, "has no robots"),
        ("a.xlsx", {}, "format is not known"),
        ("a.csv", {"run": "best"}, "run best has no tracks"),
        ("lab.mcap", {}, "is the log itself"),
    ],
)
def test_export_refuses_and_writes_nothing(
    name: str, options: dict[str, object], text: str, log: Path, tmp_path: Path
) -> None:
    before = log.read_bytes()
    path = log if name == "lab.mcap" else tmp_path / name
    with ipsys.open(log) as opened, pytest.raises(IpsysError, match=text):
        opened.export(path, **options)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
    assert log.read_bytes() == before


def test_failed_export_keeps_the_old_file(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text("old")
    _small_parts(monkeypatch)
    parts = data_frames._item_parts

    def break_later(*arguments: object) -> object:
        yield next(parts(*arguments))  # type: ignore[arg-type]
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(data_frames, "_item_parts", break_later)
    with ipsys.open(log) as opened, pytest.raises(OSError, match="No space"):
        opened.export(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_tables_of_tilted_robots_have_their_rotations(tmp_path: Path) -> None:
    sent = tilted_track("ada")
    with ipsys.open(write_tilted(tmp_path / "a.mcap")) as opened:
        table = opened.table("tracks", run="poly")
        opened.export(tmp_path / "a.parquet", "tracks", run="poly")
    assert list(pd.read_parquet(tmp_path / "a.parquet")) == list(table)
    ada, bob = (table[table["robot"] == robot].iloc[0] for robot in ("ada", "bob"))
    assert ada[["rx_rad", "ry_rad", "rz_rad"]].tolist() == TILT_RAD.tolist()
    assert ada[["wx_rad_s", "wy_rad_s", "wz_rad_s"]].tolist() == [0.3, -0.4, 0.1]
    assert sent.pose_covariance is not None
    names = {"cov_x_rx_m_rad": (0, 3), "cov_z_ry_m_rad": (2, 4), "cov_rx_rz_rad2": (3, 5)}
    assert ada[[*names]].tolist() == [sent.pose_covariance[place] for place in names.values()]
    assert bob[["rx_rad", "wz_rad_s", *names]].isna().all()
    with ipsys.open(write_tilted(tmp_path / "level.mcap", is_level=True)) as opened:
        assert "rx_rad" not in opened.table("tracks", run="poly")


def test_trajectories_of_tilted_robots_have_their_rotations(tmp_path: Path) -> None:
    with ipsys.open(write_tilted(tmp_path / "a.mcap")) as opened:
        for suffix in ("tum", "kitti"):
            opened.export(tmp_path / f"a.{suffix}", "tracks", run="poly", robot="ada")
    turn = Rotation.from_rotvec(TILT_RAD)
    assert np.loadtxt(tmp_path / "a.tum")[0, 1:] == pytest.approx([1.0, 2.0, 0.1, *turn.as_quat()])
    matrix = np.loadtxt(tmp_path / "a.kitti")[0].reshape(3, 4)
    assert matrix == pytest.approx(np.column_stack([turn.as_matrix(), [1.0, 2.0, 0.1]]))
