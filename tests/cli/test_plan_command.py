"""``ipsys plan`` on the command line."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, Measurement, Message, Rig
from ipsys_log.messages.channels import MEASUREMENTS, MODEL
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys, data_section

PAPER = ROOT / "sample_logs" / "paper_lab.mcap"


@pytest.fixture
def paper(tmp_path: Path) -> Path:
    """Write the paper's layout without frames."""
    return Path(shutil.copy(PAPER, tmp_path / "paper.mcap"))


@pytest.fixture(scope="module")
def fitted_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the paper's layout with a fitted model for a plan; tests copy it before a change."""
    path = Path(shutil.copy(PAPER, tmp_path_factory.mktemp("fitted") / "paper.mcap"))
    replay([path], Request(models=("best",)), until="fit")
    return path


@pytest.fixture
def fitted(fitted_log: Path, tmp_path: Path) -> Path:
    """Copy the log with the model."""
    return Path(shutil.copy(fitted_log, tmp_path / "paper.mcap"))


@pytest.fixture
def authors(ipsys: Ipsys, data: Path, tmp_path: Path) -> Path:
    log = tmp_path / "imsel.mcap"
    assert ipsys("import", "imsel", data / "imsel", "-o", log).code == 0
    return log


def drop_measured(message: Message) -> Message | None:
    return None if isinstance(message.payload, Measurement) else message


def planned(ipsys: Ipsys, *arguments: object) -> dict[str, Any]:
    done = ipsys("plan", *arguments, "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    assert isinstance(found, dict)
    return found


def refused(ipsys: Ipsys, log: Path, *arguments: object) -> str:
    """Return the one line of an impossible plan, and check that no file was written."""
    before = {path.name: path.read_bytes() for path in log.parent.iterdir()}
    done = ipsys("plan", log, *arguments)
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith("ipsys: ")
    assert done.err.count("\n") == 1
    assert {path.name: path.read_bytes() for path in log.parent.iterdir()} == before
    return done.err


def test_the_plan_is_a_table_and_a_headline(
    ipsys: Ipsys, paper: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    section = data_section(paper)
    done = ipsys("plan", paper)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert max(map(len, lines)) <= 80, done.out
    rows = [line for line in lines if line[:1].isdigit()]
    assert [row.split()[0] for row in rows] == ["1", "2", "3", "4", "5"]
    assert lines[-1].startswith("predicted mean error over the floor: 0.")
    assert "cm with these 5 points" in lines[-1]
    # The missing model was fitted and appended; the recorded data are unchanged.
    assert "fit           run best  1 message\n" in done.err
    assert data_section(paper).startswith(section)
    with Session([paper]) as session:
        assert session.topics(MODEL, "best") == ["/runs/best/model"]
    again, size = ipsys("plan", paper), paper.stat().st_size
    assert again.out == done.out
    assert size == paper.stat().st_size


def test_the_plan_as_json(ipsys: Ipsys, fitted: Path) -> None:
    found = planned(ipsys, fitted, "--places", 3)
    assert (found["model"], found["run"]) == ("best", "best")
    assert [place["number"] for place in found["places"]] == [1, 2, 3]
    before_m = found["mean_before_m"]
    for place in found["places"]:
        assert place["mean_before_m"] == before_m
        before_m = place["mean_after_m"]
        assert before_m < place["mean_before_m"]
        x_m, y_m = place["x_m"], place["y_m"]
        assert (x_m, y_m) == (round(x_m, 2), round(y_m, 2))
        assert 0.1 <= x_m <= 4.78
        assert 0.1 <= y_m <= 4.78
        assert place["height_m"] in (0.0, 0.05, 0.1, 0.15, 0.2)
        assert place["distances_m"] == {
            "A": pytest.approx(np.hypot(x_m - 1.2192, y_m - 2.4384)),
            "B": pytest.approx(np.hypot(x_m - 3.6576, y_m - 2.4384)),
        }
        assert place["side"] == ("left" if y_m > 2.4384 else "right")
        assert set(place["cameras"]) <= {"red", "white", "black"}
    assert found["mean_after_m"] == before_m
    assert any("little" in note for note in found["notes"])


@pytest.mark.slow
def test_plan_uses_the_given_heights_and_model(ipsys: Ipsys, fitted: Path) -> None:
    found = planned(ipsys, fitted, "--height-m", "0.12", "--places", 2)
    assert {place["height_m"] for place in found["places"]} == {0.12}
    found = planned(ipsys, fitted, "--height-m", "0.12", "--height-m", "0", "--places", 2)
    # Most points were measured at about 12 cm, so the floor itself is next.
    assert {place["height_m"] for place in found["places"]} == {0.0}
    for model in ("poly", "rigid+poly", "rayplane"):
        rig = fitted.with_name("lab.toml")
        if model == "rayplane":
            ipsys("init", rig, "--from", fitted)
            rig.write_text(rig.read_text().replace("marker_height_m = 0.1\n", "marker_height_m = 0.2\n"))
        found = planned(
            ipsys, fitted, "--model", model, *(["--rig", rig] if rig.exists() else []), "--places", 1
        )
        assert found["model"] == model
        # The error is that of markers at the height on the robots, if the rig has this height.
        assert found["marker_height_m"] == pytest.approx(0.2 if model == "rayplane" else 0.1, abs=0.02)


def test_figure_of_the_plan_is_drawn(ipsys: Ipsys, fitted: Path) -> None:
    drawn = fitted.with_name("plan.png")
    done = ipsys("plan", fitted, "--plot", drawn, "--places", 7)
    assert done.code == 0, done.err
    picture = cv2.imread(str(drawn))
    assert picture is not None
    assert picture.shape == (700, 1400, 3)
    left, right = picture[90:590, 75:580].astype(int), picture[90:590, 705:1210].astype(int)
    # The figure shows the same floor twice, with other errors.
    same = (left == right).all(axis=2).mean()
    assert 0.1 < same < 0.99
    assert sorted(path.name for path in fitted.parent.iterdir()) == ["paper.mcap", "plan.png"]


# Plans ten points on the published data.
@pytest.mark.slow
def test_plan_for_ten_paper_points_fills_the_gaps(ipsys: Ipsys, authors: Path) -> None:
    found = planned(ipsys, authors, "--train", "train_10", "--places", 6)
    with Session([authors]) as session:
        measurements = session.payloads(session.topics(MEASUREMENTS))
    points = [m.point for m in measurements if "train_10" in m.splits]
    measured_m = np.array([(p.x_m, p.y_m) for p in points])
    planned_m = np.array([(place["x_m"], place["y_m"]) for place in found["places"]])

    def nearest_m(at_m: Any) -> Any:
        return np.linalg.norm(at_m[:, None] - measured_m, axis=2).min(axis=1)

    floor_m = np.stack(np.meshgrid(np.arange(0.1, 4.8, 0.1), np.arange(0.1, 4.8, 0.1)), axis=-1).reshape(
        -1, 2
    )
    assert nearest_m(planned_m).mean() > 1.3 * nearest_m(floor_m).mean()
    assert nearest_m(planned_m).min() > 0.25
    # The wide gap right of the centre, without points of black, is first.
    first = planned_m[0]
    assert 3.0 < first[0] < 4.8
    assert 2.5 < first[1] < 3.7
    assert found["mean_after_m"] < 0.75 * found["mean_before_m"]
    sides = [place["side"] for place in found["places"]]
    assert sides == ["left" if y_m > 2.4384 else "right" for _, y_m in planned_m]
    assert set(sides) == {"left", "right"}
    # With all 40 points per camera, little improvement is left.
    full = planned(ipsys, authors, "--places", 6)
    assert full["mean_after_m"] > 0.95 * full["mean_before_m"]


def test_plan_without_calibration_points_names_the_first_step(ipsys: Ipsys, paper: Path) -> None:
    log = rewrite(paper, drop_measured)
    line = refused(ipsys, log)
    assert "has no calibration points" in line
    assert "measure about 10 points over the whole view of each camera" in line


def test_impossible_plan_is_refused(ipsys: Ipsys, paper: Path) -> None:
    assert "does not exist" in refused(ipsys, paper, paper.with_name("none.mcap"))
    for count in (0, -1, 51):
        assert f"--places {count}: is not between 1 and 50" in refused(ipsys, paper, "--places", count)
    assert "model 'spline' is not known; use one of" in refused(ipsys, paper, "--model", "spline")
    for height in ("-0.1", "15", "nan", "inf"):
        assert f"--height-m {height}: " in refused(ipsys, paper, "--height-m", height)
    assert "no measurement has the label 'half'" in refused(ipsys, paper, "--train", "half")
    assert "there is no folder" in refused(ipsys, paper, "--plot", paper.parent / "nowhere" / "plan.png")
    assert ipsys("fit", paper, "--model", "best").code == 0
    # The height is above the cameras, but not above the limit for the floor.
    assert "no camera sees a whole marker 3.5 m above the floor" in refused(ipsys, paper, "--height-m", "3.5")


def test_missing_data_of_the_log_give_notes(ipsys: Ipsys, authors: Path) -> None:
    """The log has no intrinsics, no floor, no reference points, and a camera without points."""

    def bare(message: Message) -> Message | None:
        payload = message.payload
        if isinstance(payload, CameraCalibration):
            return None
        if isinstance(payload, Rig):
            return replace(message, payload=replace(payload, floor=None, reference_points=()))
        if isinstance(payload, Measurement) and payload.id.startswith("black"):
            return None
        return message

    found = planned(ipsys, rewrite(authors, bare), "--train", "train_10")
    assert {camera for place in found["places"] for camera in place["cameras"]} <= {"red", "white"}
    assert all(place["distances_m"] == {} and place["side"] is None for place in found["places"])
    notes = " ".join(found["notes"])
    assert "camera black has no model: first measure about 10 points in its field of view" in notes
    assert "camera red has no intrinsics" in notes
    assert "the rig has no floor" in notes
    assert "fewer than two reference points" in notes


def test_plan_with_three_reference_points_gives_no_side(ipsys: Ipsys, fitted: Path) -> None:
    rig = fitted.with_name("lab.toml")
    ipsys("init", rig, "--from", fitted)
    rig.write_text(rig.read_text() + '\n[[reference_points]]\nname = "corner"\nx_m = 0.0\ny_m = 0.0\n')
    found = planned(ipsys, fitted, "--rig", rig, "--places", 1)
    (place,) = found["places"]
    assert place["side"] is None
    assert place["distances_m"]["corner"] == pytest.approx(np.hypot(place["x_m"], place["y_m"]))
    done = ipsys("plan", fitted, "--rig", rig, "--places", 1)
    assert "with this point" in done.out
    assert "corner" in done.out


def test_planned_markers_do_not_cover_a_reference_point(ipsys: Ipsys, fitted: Path) -> None:
    rig = fitted.with_name("lab.toml")
    ipsys("init", rig, "--from", fitted)
    (best,) = planned(ipsys, fitted, "--rig", rig, "--places", 1)["places"]
    x_m, y_m = best["x_m"], best["y_m"]
    rig.write_text(rig.read_text() + f'\n[[reference_points]]\nname = "C"\nx_m = {x_m}\ny_m = {y_m}\n')
    (other,) = planned(ipsys, fitted, "--rig", rig, "--places", 1)["places"]
    assert 0.1 < other["distances_m"]["C"] < 0.5


def test_a_model_that_was_copied_in_can_be_planned_for(ipsys: Ipsys, fitted: Path, tmp_path: Path) -> None:
    other = rewrite(Path(shutil.copy(PAPER, tmp_path / "other.mcap")), drop_measured)
    assert ipsys("fit", other, "--model", "best", "--model-from", fitted).code == 0
    assert planned(ipsys, other)["places"] == planned(ipsys, fitted)["places"]
