"""The catalogue of a folder: its rows by another way, its updates, and its readers."""

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import fsspec
import pandas as pd
import pytest

from ipsys_log.api import python_api as api
from ipsys_log.api.catalogue import Baseline, update_catalogue
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine import output
from ipsys_log.engine.graph import VERSIONS
from ipsys_log.engine.output import append_messages, write_log
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.row_files import Columns, read_rows, write_rows
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogUrl
from ipsys_log.messages import Event, Message
from ipsys_log.messages.channels import EVALUATION, EVENTS_TOPIC
from tests.conftest import ROOT, Ipsys
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.geometric.weeks import Knock, WeekSettings, simulate_week

GOLDEN = ROOT / "tests" / "golden" / "v0_1_0.mcap"
SMALL_LAB = ROOT / "sample_logs" / "small_lab.mcap"
PAPER_LAB = ROOT / "sample_logs" / "paper_lab.mcap"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with an evaluated log, a log without runs of models, and a broken one."""
    logs = tmp_path / "logs"
    (logs / "2026").mkdir(parents=True)
    shutil.copy(GOLDEN, logs / "2026" / "golden.mcap")
    shutil.copy(PAPER_LAB, logs / "paper.mcap")
    (logs / "broken.mcap").write_bytes(GOLDEN.read_bytes()[:50_000])
    return logs


def rows_of(path: Path) -> dict[str, dict[str, Any]]:
    rows: list[Any] = pd.read_parquet(path).to_dict("records")
    return {row["log"]: row for row in rows}


def test_row_has_the_contents_of_its_log(folder: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    target = tmp_path / "catalogue.parquet"
    (folder / "images.mcap").symlink_to(SMALL_LAB)
    update = update_catalogue(folder, target)
    assert (update.logs, update.read, set(update.errors)) == (4, 4, {"broken.mcap"})
    row = rows_of(target)["images.mcap"]
    info = json.loads(ipsys("info", SMALL_LAB, "--json").out)
    assert row["duration_s"] == info["duration_s"]
    assert row["start_utc"].isoformat(" ").startswith(info["start"])
    assert [camera["camera"] for camera in row["cameras"]] == sorted(info["cameras"])
    for found in row["cameras"]:
        camera = info["cameras"][found["camera"]]
        channel = info["channels"][camera["images"]]
        assert found["images"] == channel["messages"]
        assert found["calibrated"] == (camera["calibration"] is not None)
        for key in ("rate_hz", "gaps", "longest_gap_s"):
            assert found[key] == channel[key], key
    row = rows_of(target)["2026/golden.mcap"]
    listed = json.loads(ipsys("runs", GOLDEN, "--json").out)
    states = [(one["run"], one["stage"], one["state"]) for one in listed["rows"]]
    assert [(one["run"], one["stage"], one["state"]) for one in row["runs"]] == states
    assert {one["ipsys"] for one in row["runs"]} == {"0.1.0"}
    means = {
        (one["model"], one["camera"], one["scheme"], one["dimensions"]): one["mean_m"]
        for one in row["evaluations"]
        if one["against"] == "tape"
    }
    with Session([GOLDEN]) as session:
        for run in session.run_names():
            for evaluation in session.payloads(session.topics(EVALUATION, run)):
                assert evaluation.model in row["models"]
                for one in evaluation.cameras:
                    errors_of = evaluation.model, one.camera, one.scheme or "held_out", "2d"
                    assert one.against != "tape" or means[errors_of] == one.error_2d.mean_m


def test_broken_log_is_a_row_with_its_error(folder: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    done = ipsys("catalogue", folder, "-o", tmp_path / "c.parquet")
    assert done.code == 0
    assert "3 logs, 3 read" in done.out
    row = rows_of(tmp_path / "c.parquet")["broken.mcap"]
    assert row["error"].startswith("has no end")
    assert f"broken.mcap: {row['error']}" in done.out
    assert pd.isna(row["start_utc"])
    assert row["bytes"] == 50_000


def test_names_that_are_not_utf_8_and_broken_links_are_rows(tmp_path: Path) -> None:
    folder, target = tmp_path / "logs", tmp_path / "c.parquet"
    folder.mkdir()
    (folder / os.fsdecode(b"red\xff.mcap")).write_bytes(b"no log")
    (folder / "gone.mcap").symlink_to("nowhere.mcap")
    assert set(update_catalogue(folder, target).errors) == {"red\\udcff.mcap", "gone.mcap"}
    assert rows_of(target)["gone.mcap"]["error"] == "does not exist"
    assert update_catalogue(folder, target).read == 0
    # The disk of the linked log is mounted.
    shutil.copy(PAPER_LAB, folder / "nowhere.mcap")
    assert update_catalogue(folder, target).read == 2


def test_only_new_and_changed_logs_are_read(folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "catalogue.parquet"
    update_catalogue(folder, target)
    first = target.read_bytes()
    assert update_catalogue(folder, target).read == 0
    assert target.read_bytes() == first
    # A log with another event, a new log, and a deleted one.
    with Session([folder / "paper.mcap"]) as session:
        end_ns = session.end_ns + 1
    event = Event(end_ns, "camera_moved", "camera red has moved", "red")
    append_messages(folder / "paper.mcap", [Message(EVENTS_TOPIC, end_ns, end_ns, event)])
    shutil.copy(GOLDEN, folder / "new.mcap")
    (folder / "broken.mcap").unlink()
    update = update_catalogue(folder, target)
    assert (update.logs, update.read, update.removed, dict(update.errors)) == (3, 2, 1, {})
    rows = rows_of(target)
    assert {"kind": "camera_moved", "camera": "red", "count": 1} in [*rows["paper.mcap"]["events"]]
    # An update gives the same rows as a new catalogue.
    update_catalogue(folder, tmp_path / "again.parquet")
    assert target.read_bytes() == (tmp_path / "again.parquet").read_bytes()


def test_questions_of_the_documentation_have_answers(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import duckdb

    ask: Any = duckdb.sql
    monkeypatch.chdir(tmp_path)
    update_catalogue(folder, tmp_path / "catalogue.parquet")
    page = (ROOT / "docs" / "scale.md").read_text(encoding="utf-8")
    questions = re.findall(r"```sql\n(.*?)```", page, re.DOTALL)
    errors, drift, outdated, _ = [ask(question).fetchall() for question in questions]
    assert {model for _, model, *_ in errors} == {"rigid", "poly", "best"}
    assert drift == []  # no baseline
    assert [(log, made_by) for log, _, made_by in outdated] == [("2026/golden.mcap", ["0.1.0"])]
    pandas = page.rpartition("```python\n")[2].partition("```")[0]
    exec(pandas, {})


def test_derived_log_counts_with_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ipsys: Ipsys
) -> None:
    """The question for runs of an older version names the log in the store, not its derived log."""
    store = fsspec.filesystem("memory")
    store.pipe_file("/lab/2026-05/a.mcap", PAPER_LAB.read_bytes())
    store.pipe_file("/lab/2026-06/a.mcap", PAPER_LAB.read_bytes())
    derived, target = tmp_path / "results" / "2026-05" / "a.derived.mcap", tmp_path / "catalogue.parquet"
    derived.parent.mkdir(parents=True)
    api.replay(PAPER_LAB, models=("rigid",), until="fit", output=derived)
    command = ("catalogue", "memory:///lab/2026-*/a.mcap", "-o", target, "--derived", tmp_path / "results")

    def rows() -> dict[str, dict[str, Any]]:
        done = ipsys(*command)
        assert done.code == 0, done.err
        return rows_of(target)

    found = rows()
    assert [*found] == ["2026-05/a.mcap", "2026-06/a.mcap"]
    assert found["2026-05/a.mcap"]["derived"] == str(derived)
    assert pd.isna(found["2026-06/a.mcap"]["derived"])
    has_run = {log: "rigid" in [run["run"] for run in row["runs"]] for log, row in found.items()}
    assert has_run == {"2026-05/a.mcap": True, "2026-06/a.mcap": False}
    assert "2 logs, 0 read" in ipsys(*command).out
    monkeypatch.setitem(VERSIONS, "rigid", 2)
    outdated = {log: list(row["outdated_runs"]) for log, row in rows().items()}
    assert outdated == {"2026-05/a.mcap": ["rigid"], "2026-06/a.mcap": []}
    derived.unlink()
    assert "2 logs, 1 read" in ipsys(*command).out
    assert list(rows_of(target)["2026-05/a.mcap"]["outdated_runs"]) == []


def test_derived_log_in_the_folder_has_no_row(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = folder / "2026" / "golden.mcap"
    derived = folder / "golden.derived.mcap"
    api.replay(log, models=("rigid",), until="fit", run="again", output=derived)
    monkeypatch.setattr(output, "_can_append", lambda path: path != log)  # also for root
    update = update_catalogue(folder, tmp_path / "catalogue.parquet", derived=folder)
    assert update.logs == 3
    assert rows_of(tmp_path / "catalogue.parquet")["2026/golden.mcap"]["derived"] == str(derived)


def test_derived_log_of_another_log_is_an_error_of_the_row(tmp_path: Path) -> None:
    fsspec.filesystem("memory").pipe_file("/other/a.mcap", SMALL_LAB.read_bytes())
    api.replay(PAPER_LAB, models=("rigid",), until="fit", output=tmp_path / "a.derived.mcap")
    update = update_catalogue(LogUrl("memory:///other/*.mcap"), tmp_path / "c.parquet", derived=tmp_path)
    assert "has results of another log than memory:///other/a.mcap" in update.errors["a.mcap"]


def test_file_of_another_kind_is_not_overwritten(folder: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    target = tmp_path / "notes.parquet"
    target.write_text("notes of a year")
    done = ipsys("catalogue", folder, "-o", target)
    assert done.code == 1
    assert f"{target}: cannot be read as a Parquet file" in done.err
    assert target.read_text() == "notes of a year"
    write_rows(target, [{"robot": "ada"}], {"robot": "string"})
    done = ipsys("catalogue", folder, "-o", target)
    assert (done.code, "is not a catalogue" in done.err) == (1, True)
    assert pd.read_parquet(target)["robot"].tolist() == ["ada"]
    for wrong, right in ((tmp_path / "c.csv", tmp_path / "c.parquet"), (".", "FILE.parquet")):
        done = ipsys("catalogue", folder, "-o", wrong)
        assert (done.code, done.err.endswith(f"the name must end in .parquet; use {right}\n")) == (1, True)
    done = ipsys("catalogue", folder, "-o", tmp_path / "c.parquet", "--baseline", "")
    assert (done.code, "--baseline .: is not a file; name a log" in done.err) == (1, True)
    with pytest.raises(IpsysError, match="is not a folder"):
        update_catalogue(GOLDEN, tmp_path / "c.parquet")


def test_folder_without_logs_gets_no_catalogue(folder: Path, tmp_path: Path) -> None:
    """A wrong folder is refused; a catalogue whose logs have gone becomes empty."""
    target, empty = tmp_path / "c.parquet", tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(IpsysError, match=r"empty: has no file that ends in \.mcap"):
        update_catalogue(empty, target)
    assert not target.exists()
    update_catalogue(folder, target)
    assert update_catalogue(empty, target).logs == 0


def test_rows_of_parquet_come_back(tmp_path: Path) -> None:
    columns: Columns = {
        "name": "string",
        "at": "time",
        "sizes": {"n": "int64", "share": "float64"},
        "tags": "list<string>",
    }
    rows: list[dict[str, Any]] = [
        {"name": "a", "at": 1_700_000_000_000_001_000, "sizes": [{"n": 1, "share": 0.5}], "tags": ["x", "y"]},
        {"name": None, "at": None, "sizes": None, "tags": []},
    ]
    write_rows(tmp_path / "rows.parquet", rows, columns, "mark")
    assert read_rows(tmp_path / "rows.parquet") == ("mark", rows)


@pytest.mark.slow
def test_outdated_runs_are_replayed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ipsys_log.api.batch.log_work import replay_log

    log = Path(shutil.copy(PAPER_LAB, tmp_path / "log.mcap"))
    options: dict[str, Any] = {"outdated": True, "models": ("rigid",)}
    api.replay(log, models=("rigid",))
    before = log.read_bytes()
    assert replay_log(log, **options).state == "not outdated"
    assert log.read_bytes() == before
    monkeypatch.setitem(VERSIONS, "rigid", 2)
    result = replay_log(log, **options)
    assert (result.state, result.runs) == ("computed", ("rigid_2",))
    assert "run rigid is out of date" in result.text
    # The old run is superseded: nothing is left to do.
    assert replay_log(log, **options).state == "not outdated"


WEEKS = WeekSettings(duration_s=3.0, knocks=(Knock("white", 3, (0.0010, 0.0020, 0.0003)),))


def settings(drive_s: float) -> GeometricSettings:
    return GeometricSettings(lab=LabSettings(seed=3, rate_hz=10.0, drive_s=drive_s, markers=2), points=30)


@pytest.mark.slow
def test_camera_that_was_knocked_has_moved_in_later_logs(tmp_path: Path) -> None:
    model, folder = tmp_path / "model.mcap", tmp_path / "weeks"
    write_log(model, simulate_session(build_lab(settings(5.0))))
    api.replay(model, models=("best",), until="fit")
    folder.mkdir()
    for week in (1, 2, 3, 4):
        write_log(folder / f"week{week}.mcap", simulate_week(build_lab(settings(0.0)), WEEKS, week))
    target, baseline = tmp_path / "catalogue.parquet", Baseline(folder / "week1.mcap", model)
    assert update_catalogue(folder, target, baseline).read == 4
    rows = pd.read_parquet(target).set_index("log")
    for week in (1, 2, 3, 4):
        row: Any = rows.loc[f"week{week}.mcap"]
        assert pd.isna(row["drift_error"])
        moved = {camera["camera"] for camera in row["drift"] if camera["moved"]}
        assert moved == ({"white"} if week >= 3 else set())
    assert update_catalogue(folder, target, baseline).read == 0
    # Without its baseline, a catalogue has no drift.
    assert update_catalogue(folder, target).read == 4
    assert pd.read_parquet(target)["drift"].isna().all()
