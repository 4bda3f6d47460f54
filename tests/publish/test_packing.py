"""Packs: their content, their scores, and the comparison of a repetition with them."""

import hashlib
import io
import json
import re
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import ipsys_log
from ipsys_log.app.report.pack_scores import score_answer, score_tables
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import CAMERA_POINTS, IMAGES, MARKERS, TRACKS
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.models.closed_form import PolynomialRegression
from ipsys_log.tools.publish.kept_contents import blur_image
from ipsys_log.tools.publish.packing import pack
from ipsys_log.tools.publish.scores import Score
from ipsys_log.tools.publish.scoring import ScoreComparison, ScoreResult, score
from ipsys_log.vision.decode import decode_grey
from tests.conftest import Ipsys
from tests.publish.packs import SCORED, change_scores, contents, sign
from tests.tiers import first_fast


def test_equal_logs_give_equal_packs(packed: Path, tmp_path: Path) -> None:
    for name in ("dataset", "dataset.zip"):
        pack([packed / "lab.mcap"], tmp_path / name, packed / "card.toml", models=SCORED)
    assert contents(tmp_path / "dataset") == contents(packed / "dataset")
    assert (tmp_path / "dataset.zip").read_bytes() == (packed / "dataset.zip").read_bytes()


def test_archive_has_the_files_of_the_folder(packed: Path) -> None:
    with zipfile.ZipFile(packed / "dataset.zip") as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == contents(packed / "dataset")


def test_checksums_are_those_of_other_programs(packed: Path) -> None:
    folder = packed / "dataset"
    lines = dict(line.split("  ")[::-1] for line in (folder / "SHA256SUMS").read_text().splitlines())
    files = contents(folder)
    assert set(lines) == set(files) - {"SHA256SUMS"}
    assert lines == {name: hashlib.sha256(files[name]).hexdigest() for name in lines}
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"], cwd=folder, check=True)


@pytest.mark.filterwarnings("ignore")
def test_manifest_is_valid_croissant(packed: Path) -> None:
    import mlcroissant

    found = mlcroissant.Dataset(jsonld=packed / "dataset/croissant.json")
    assert (found.metadata.ctx.issues.errors, found.metadata.ctx.issues.warnings) == (set(), set())
    assert found.metadata.name == "Small lab"
    rows = [
        {name.removeprefix("scores/"): value for name, value in record.items()}
        for record in found.records("scores")
    ]
    plain = [
        {name: value.decode() if isinstance(value, bytes) else value for name, value in row.items()}
        for row in rows
    ]
    assert plain == json.loads((packed / "dataset/scores.json").read_text())["scores"]


def test_scores_are_those_of_evaluate(packed: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    log = shutil.copy(packed / "lab.mcap", tmp_path / "lab.mcap")
    models = [word for name in SCORED for word in ("--model", name)]
    evaluated = json.loads(ipsys("evaluate", log, *models, "--json").out)["models"]
    stated = json.loads((packed / "dataset/scores.json").read_text())["scores"]
    assert {(row["model"], row["scheme"], row["dimensions"]) for row in stated} == {
        (model, scheme, dimensions)
        for model in SCORED
        for scheme in ("held_out", "cross_validation")
        for dimensions in ("3d", "2d")
    }
    for row in stated:
        camera = evaluated[row["model"]]["cameras"]["red"]
        errors = (camera if row["scheme"] == "held_out" else camera[row["scheme"]])[row["dimensions"]]
        assert row["points"] == errors["count"]
        for name in ("mean", "median", "p95", "rmse"):
            assert row[f"{name}_mm"] == pytest.approx(errors[f"{name}_m"] * 1000, abs=1e-6)


@pytest.mark.parametrize("name", ["dataset", "dataset.zip"])
def test_score_repeats_the_scores_and_changes_nothing(
    packed: Path, name: str, ipsys: Ipsys, temporary: Path
) -> None:
    before = contents(packed)
    done = ipsys("score", packed / name)
    assert done.code == 0, done.err
    assert done.out.startswith(
        "Small lab: the scores of 2 models come out as stated. Largest difference: 0 mm."
    )
    assert contents(packed) == before
    assert list(temporary.iterdir()) == []


def test_long_answer_fits_80_columns() -> None:
    stated = [
        made_score(name, scheme, dimensions=dimensions, tolerance_mm=0.01)
        for name in ("rigid+kriging-regression", "kriging-regression")
        for scheme in ("held_out", "cross_validation")
        for dimensions in ("3d", "2d")
    ]
    comparisons = [ScoreComparison(one, replace(one, mean_mm=5678.9, tolerance_mm=None)) for one in stated]
    own = [
        made_score("a_long_file_name.py:Estimator", one.scheme, dimensions=one.dimensions) for one in stated
    ]
    result = ScoreResult("The title of a dataset", tuple(stated), tuple(comparisons[1:]), tuple(own[:4]))
    wide = Console(width=200, file=io.StringIO())
    for part in (score_answer(result), *score_tables(result)):
        wide.print(part)
    text = wide.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, map(str.rstrip, text.splitlines()))) <= 80, text
    plain = " ".join(text.split())
    assert "7 of 7 scores of 2 models do not come out as stated." in plain
    assert "mean 5678.900 mm, stated is 1234.500 mm; the tolerance is 0.010 mm." in plain
    assert "a_long_file_name.py:Estimator: mean error 1234.500 mm" in plain


@pytest.mark.parametrize("figure", ["mean_mm", "median_mm", "p95_mm", "rmse_mm"])
def test_wrong_stated_figure_is_found(dataset: Path, figure: str, ipsys: Ipsys) -> None:
    def worsen(table: dict[str, Any]) -> None:
        row = next(row for row in table["scores"] if row["model"] == "rigid")
        row[figure] += 1.5 * row["tolerance_mm"]

    change_scores(dataset, worsen)
    done = ipsys("score", dataset, "--model", "rigid", "--json")
    assert done.code == 1
    found = json.loads(done.out)
    assert found["as_stated"] is False
    assert [row["as_stated"] for row in found["comparisons"]] == [False, True, True, True]
    assert found["comparisons"][0]["difference_m"] == pytest.approx(15e-6, abs=1e-9)


def made_score(
    model: str = "poly",
    scheme: str = "held_out",
    points: int = 10,
    dimensions: str = "3d",
    p95_mm: float = 20,
    tolerance_mm: float | None = None,
) -> Score:
    return Score(
        model=model,
        scheme=scheme,
        against="tape",
        dimensions=dimensions,
        points=points,
        mean_mm=1234.5,
        median_mm=9,
        p95_mm=p95_mm,
        rmse_mm=12,
        tolerance_mm=tolerance_mm,
    )


def test_score_within_its_tolerance_is_as_stated() -> None:
    stated = made_score(tolerance_mm=0.5)
    assert ScoreComparison(stated, made_score(p95_mm=20.5)).as_stated
    assert not ScoreComparison(stated, made_score(p95_mm=20.51)).as_stated
    assert not ScoreComparison(stated, made_score(p95_mm=19.49)).as_stated
    assert not ScoreComparison(stated, made_score(points=9)).as_stated
    assert not ScoreComparison(stated, None).as_stated


def test_rig_file_is_the_rig_of_the_logs(packed: Path) -> None:
    with Session([packed / "dataset/logs/lab.mcap"]) as session:
        assert load_rig(packed / "dataset/lab.toml") == session.payloads(["/rig"])[-1]


def test_pack_without_images_scores_as_the_log(detected_log: Path, packed: Path, tmp_path: Path) -> None:
    log = Path(shutil.copy(detected_log, tmp_path / "lab.mcap"))
    replay([log], Request(models=("rigid",)))
    done = pack([log], tmp_path / "small", packed / "card.toml", models=["rigid"], without_images=True)
    assert done.size < log.stat().st_size / 20
    with Session([tmp_path / "small/logs/lab.mcap"]) as session:
        assert session.images == {}
        assert session.topics(MARKERS, "edges") != []
        assert session.topics(CAMERA_POINTS, "edges") == session.topics(TRACKS, "rigid") == []
    result = score(tmp_path / "small")
    assert result.as_stated
    (evaluated,) = ipsys_log.replay(log, models=["rigid"], until="evaluate").evaluations.values()
    rows = [row for row in evaluated.evaluation.cameras if row.camera == ""]
    means_m = sorted(e.mean_m for row in rows for e in (row.error_3d, row.error_2d) if e is not None)
    assert sorted(one.mean_mm for one in done.scores) == pytest.approx(np.array(means_m) * 1000, abs=1e-6)


# Markers are detected twice in all images.
@pytest.mark.slow
def test_pack_with_images_detects_markers_again(replayed_log: Path, packed: Path, tmp_path: Path) -> None:
    done = pack([replayed_log], tmp_path / "whole.zip", packed / "card.toml", models=["rigid"])
    thinned = pack([replayed_log], tmp_path / "half", packed / "card.toml", models=["rigid"], every=2)
    with Session([tmp_path / "half/logs/lab.mcap"]) as half, Session([replayed_log]) as whole:
        assert [run for run in half.run_names() if half.topics(MARKERS, run)] == []
        for one, other in zip(half.topics(IMAGES), whole.topics(IMAGES), strict=True):
            assert half.count(one) == -(-whole.count(other) // 2)
    assert thinned.scores != done.scores
    for name in ("whole.zip", "half"):
        result = score(tmp_path / name)
        assert result.as_stated
        assert {one.stated.tolerance_mm for one in result.comparisons} == {2.0}  # 960 px wide


def test_images_without_markers_are_named(lab_log: Path, packed: Path, tmp_path: Path) -> None:
    with pytest.raises(
        IpsysError, match="has no markers, which a pack without images needs; run: ipsys replay --until det"
    ):
        pack([lab_log], tmp_path / "x", packed / "card.toml", without_images=True)
    assert list(tmp_path.iterdir()) == []


def test_logs_of_one_name_get_different_names(packed: Path, tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    second = tmp_path / "b/LAB.mcap"
    with Session([packed / "lab.mcap"]) as session:
        write_log(second, session.messages(["/rig"]))
    said: list[str] = []
    done = pack(
        [second, packed / "lab.mcap"], tmp_path / "x", packed / "card.toml", models=["rigid"], say=said.append
    )
    assert said == [f"{second}: is left out, because it has no recorded messages"]
    assert "logs/lab.mcap" in done.files


def test_log_without_calibration_points_leaves_nothing(packed: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    log = tmp_path / "none.mcap"
    assert ipsys("cut", packed / "lab.mcap", "-o", log, "--exclude-topics", "/measurements").code == 0
    before = contents(tmp_path)
    done = ipsys("pack", log, "-o", tmp_path / "dataset", "--card", packed / "card.toml")
    assert done.code == 1
    assert len(done.err.splitlines()) == 1, done.err
    assert contents(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == ["none.mcap"]


@pytest.mark.parametrize("name", ["dataset", "dataset.zip"])
def test_existing_output_is_not_replaced(packed: Path, tmp_path: Path, name: str, ipsys: Ipsys) -> None:
    (tmp_path / name).mkdir()
    done = ipsys("pack", packed / "lab.mcap", "-o", tmp_path / name, "--card", packed / "card.toml")
    assert (done.code, "exists already; choose another name" in done.err) == (1, True)
    assert list((tmp_path / name).iterdir()) == []


def test_pack_names_what_is_missing(packed: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    log = packed / "lab.mcap"
    assert "pack needs logs and a dataset" in ipsys("pack", "-o", tmp_path / "x").err
    assert "to write an empty form: ipsys pack --card-form card.toml" in ipsys("pack", log, "-o", "x").err


def test_result_in_a_pack_is_refused(packed: Path, dataset: Path, tmp_path: Path) -> None:
    """A fitted model in a log would be taken over, and nothing would be computed."""
    replay([dataset / "logs/lab.mcap"], Request(models=("rigid",)), "fit")
    sign(dataset)
    with pytest.raises(
        IpsysError, match=r"logs/lab\.mcap: has the result /runs/rigid/model, which would not be"
    ):
        score(dataset)


def test_newer_model_is_named(dataset: Path, ipsys: Ipsys) -> None:
    change_scores(dataset, lambda table: table["models"].update(poly=7))
    done = ipsys("score", dataset)
    assert "The pack was scored with other versions of poly." in done.out


OWN = """
from ipsys_log.models.closed_form import PolynomialRegression

class Estimator(PolynomialRegression):
    pass

class Flat(PolynomialRegression):
    def predict(self, points_m):
        return super().predict(points_m)[:, :2]

class Unknown(PolynomialRegression):
    def predict(self, points_m):
        return super().predict(points_m) * float("nan")

class Nothing:
    pass
"""


def test_own_model_is_scored_in_the_same_folds(packed: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    """The stated polynomial, loaded from a file of the user, has its stated errors to the last digit."""
    (tmp_path / "mine.py").write_text(OWN)
    done = ipsys("score", packed / "dataset", "--model", f"{tmp_path}/mine.py:Estimator", "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    stated = json.loads((packed / "dataset/scores.json").read_text())["scores"]
    polynomial = [row for row in stated if row["model"] == "poly"]
    assert len(found["own"]) == len(polynomial) == 4
    for own, row in zip(found["own"], polynomial, strict=True):
        in_m = {f"{key[:-3]}_m": value / 1000 for key, value in row.items() if key.endswith("_mm")}
        assert own == {name: (row | in_m)[name] for name in own} | {"model": "mine.py:Estimator"}
    assert found["as_stated"] is None


def test_own_model_of_python_is_ranked(packed: Path) -> None:
    result = ipsys_log.score(packed / "dataset", models=["rigid"], own={"mine": PolynomialRegression})
    assert result.as_stated
    assert {one.stated.model for one in result.comparisons} == {"rigid"}
    assert {one.model for one in result.own} == {"mine"}
    assert ipsys_log.score(packed / "dataset", own={"mine": PolynomialRegression}).as_stated is None


# The first cases need no run of the pipeline.
_FAULTS = (
    ("mine.py:Missing", "has no class Missing"),
    ("other.py:Estimator", "other.py does not exist; give the file"),
    (":Estimator", "write the file and the class of a model"),
    ("polly", "model 'polly' is not known"),
    ("best", "states no score of best; it has rigid, poly"),
    ("mine.py:Flat", "predict returns the shape (40, 2) for 40 points; return world points (40, 3) in m"),
    ("mine.py:Unknown", "predict returns numbers that are not finite"),
    ("mine.py:Nothing", "needs the methods fit and predict"),
)


@pytest.mark.parametrize(("name", "text"), first_fast(6, _FAULTS))
def test_fault_of_an_own_model_is_named(
    packed: Path, tmp_path: Path, ipsys: Ipsys, name: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    done = ipsys("score", packed / "dataset", "--model", name)
    assert done.code == 1
    *steps, fault = done.err.splitlines()
    assert fault.startswith("ipsys: ")
    assert text in fault
    assert all(re.fullmatch(r"[a-z-]+( \w+)?: (\d+) of \2", step) for step in steps), steps


@given(st.integers(40, 300), st.integers(40, 300), st.integers(0, 2**32 - 1))
def test_marker_and_its_border_stay_sharp(width: int, height: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grey = rng.integers(0, 256, (height, width)).astype(np.uint8)
    centre, half = rng.uniform([0, 0], [width, height]), rng.uniform(4, 15)
    corners = centre + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    blurred = blur_image(grey, [corners])
    rows, columns = np.mgrid[:height, :width]
    beside = np.maximum(abs(columns - centre[0]), abs(rows - centre[1])) / half
    assert (blurred == grey)[beside < 1.3].all()
    assert blurred.shape == grey.shape


def test_blocks_hide_all_details() -> None:
    """Images with equal means of blocks give equal results: the details cannot be computed back."""
    grey = np.kron(np.arange(48, dtype=np.uint8)[None] * 4 + 40, np.ones((96, 4), np.uint8)).astype(np.uint8)
    details = grey.copy()
    details[::2, ::2] += 10
    details[1::2, 1::2] -= 10
    assert not np.array_equal(details, grey)
    assert np.array_equal(blur_image(details, []), blur_image(grey, []))


# Markers are detected in all images.
@pytest.mark.slow
def test_blurred_pack_has_scores_of_its_own(detected_log: Path, packed: Path, tmp_path: Path) -> None:
    log = Path(shutil.copy(detected_log, tmp_path / "lab.mcap"))
    done = pack([log], tmp_path / "dataset", packed / "card.toml", models=["rigid"], blur=True)
    assert "blurred outside of the markers, in grey" in (tmp_path / "dataset/README.md").read_text()
    assert score(tmp_path / "dataset").as_stated
    with Session([log]) as sharp, Session([tmp_path / "dataset/logs/lab.mcap"]) as blurred:
        assert [run for run in blurred.run_names() if blurred.topics(MARKERS, run)] == []
        for topic in sharp.topics(IMAGES):
            pairs = zip(sharp.messages([topic]), blurred.messages([topic]), strict=True)
            for one, other in pairs:
                assert one.log_time_ns == other.log_time_ns
                before, after = decode_grey(one.payload).astype(int), decode_grey(other.payload).astype(int)
                assert before.shape == after.shape
                # Most pixels are not beside a marker.
                assert (abs(before - after) > 3).mean() > 0.02
    whole = pack([log], tmp_path / "whole", packed / "card.toml", models=["rigid"])
    for own, sharp_score in zip(done.scores, whole.scores, strict=True):
        assert own.key == sharp_score.key
        assert own.mean_mm == pytest.approx(sharp_score.mean_mm, abs=0.5)


def test_blur_without_markers_or_images_is_refused(
    lab_log: Path, packed: Path, tmp_path: Path, ipsys: Ipsys
) -> None:
    with pytest.raises(IpsysError, match="which --blur keeps sharp; run: ipsys replay --until detect"):
        pack([lab_log], tmp_path / "x", packed / "card.toml", blur=True)
    arguments = ("pack", lab_log, "-o", tmp_path / "x", "--card", packed / "card.toml", "--blur")
    done = ipsys(*arguments, "--without-images")
    assert (done.code, "cannot be used together" in done.err) == (1, True)
    assert list(tmp_path.iterdir()) == []
