"""The summary of an evaluation comes first, fits a terminal, and has the figures of the JSON."""

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from ipsys_log.app.report.accuracy import Accuracy, accuracy_json, read_accuracy
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.paper_figures import cross_validation_csv
from ipsys_log.app.report.summary import answer_json, answer_text
from ipsys_log.app.report.tables import models_table
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraEvaluation, Suspect
from ipsys_log.statistics.accuracy import POOLED, error_statistics, root_mean_square_m
from ipsys_log.statistics.ground_truth import TrackErrors
from tests.conftest import Ipsys
from tests.report.conftest import ALL_MODELS, lab_messages, many_models, only, rename_cameras, scale
from tests.report.test_tables import with_truth

NAMES = ("[bold]x[/nothing]", "a\x1b[31mb", "white_11", "m4", "m5")


def printed(accuracies: Sequence[Accuracy], width: int = 80) -> str:
    """Return the summary and its table, as on a terminal that does not wrap."""
    file = io.StringIO()
    console = Console(file=file, width=width, highlight=False, soft_wrap=True)
    for part in (answer_text(accuracies), models_table(accuracies)):
        if part is not None:
            console.print(part)
    return file.getvalue()


def with_suspects(accuracy: Accuracy, count: int) -> Accuracy:
    """Return the accuracy with invented outliers, the worst first."""
    assert accuracy.evaluation is not None
    suspects = tuple(
        Suspect(name, ("red",), np.array([0.1 - 0.01 * n, 0.0, 0.0]), 9.0, "side", f"{n}: it lies right")
        for n, name in enumerate(NAMES[:count])
    )
    return replace(accuracy, evaluation=replace(accuracy.evaluation, suspects=suspects))


def with_gross_outlier(accuracy: Accuracy, factor: float = 10.0) -> Accuracy:
    """Return the accuracy with an excluded point; with it, all errors are ``factor`` times as large."""
    assert accuracy.evaluation is not None
    wrong = Suspect("gross_1", ("white",), np.array([2.0, 0.0, 0.0]), 90.0, "swapped", "they look exchanged")
    whole = scale(accuracy.evaluation, factor).cameras
    return replace(accuracy, evaluation=replace(accuracy.evaluation, excluded=(wrong,), with_excluded=whole))


def errors_of(rows: Sequence[CameraEvaluation], row: CameraEvaluation, axes: int) -> np.ndarray:
    """Return the lengths of the residuals behind a row."""
    own = [one for one in rows if (one.scheme, one.against) == (row.scheme, row.against)]
    found = [r for one in own if row.camera in (POOLED, one.camera) for r in one.residuals]
    return np.array([np.linalg.norm((r.predicted_m - r.world_m)[:axes]) for r in found])


def test_rmse_is_that_of_the_residuals(paper: Findings) -> None:
    models = accuracy_json(paper.accuracies)["models"]
    checked = 0
    for accuracy in paper.accuracies:
        assert accuracy.evaluation is not None
        rows, cameras = accuracy.evaluation.cameras, models[accuracy.model]["cameras"]
        for row in rows:
            place = cameras[row.camera] if row.camera else models[accuracy.model]["pooled"]
            place = place["cross_validation"] if row.scheme == "cross_validation" else place
            for kind, axes in (("3d", 3), ("2d", 2)):
                wanted_m = np.sqrt(np.mean(errors_of(rows, row, axes) ** 2))
                assert place[kind]["rmse_m"] == pytest.approx(wanted_m, rel=1e-9)
                checked += 1
    assert checked == 2 * 2 * (3 + 1) * 2


@given(st.lists(st.floats(1e-6, 10.0), min_size=1, max_size=30), st.integers(1, 4))
def test_rmse_follows_from_mean_and_deviation(errors_m: list[float], repeats: int) -> None:
    drawn = np.array([errors_m] * repeats) * np.linspace(1, 2, repeats)[:, None]
    wanted_m = float(np.sqrt((drawn**2).mean()))
    assert root_mean_square_m(error_statistics(drawn), repeats) == pytest.approx(wanted_m, rel=1e-9)


def test_rmse_is_in_the_table_and_the_csv(paper: Findings) -> None:
    found = accuracy_json(paper.accuracies)["models"]["poly"]["pooled"]["cross_validation"]
    text = printed(paper.accuracies)
    (row,) = [line for line in text.splitlines() if line.startswith("poly ")]
    assert f"{100 * found['3d']['rmse_m']:.2f}" in row.split()
    assert f"{100 * found['2d']['rmse_m']:.2f}" in row.split()
    rows = csv.DictReader(io.StringIO(cross_validation_csv(paper).decode()))
    (line,) = [one for one in rows if (one["method"], one["camera"]) == ("poly", "all")]
    assert line["rmse_3d_cm"] == f"{100 * found['3d']['rmse_m']:.3f}"
    assert line["rmse_2d_cm"] == f"{100 * found['2d']['rmse_m']:.3f}"


def test_rmse_of_unknown_repeats_is_missing(paper: Findings) -> None:
    accuracy = paper.accuracies[0]
    assert accuracy.evaluation is not None
    bare = tuple(replace(row, residuals=()) for row in accuracy.evaluation.cameras)
    found = replace(accuracy, evaluation=replace(accuracy.evaluation, cameras=bare))
    pooled = accuracy_json([found])["models"][accuracy.model]["pooled"]
    assert "rmse_m" not in pooled["cross_validation"]["3d"]
    assert "rmse_m" in pooled["3d"]
    assert "-" in printed([found])


def test_answer_names_model_error_and_outliers_first(paper: Findings) -> None:
    accuracies = [with_suspects(a, 5) if a.model == "poly" else a for a in paper.accuracies]
    first, *rest = printed(accuracies, 200).splitlines()
    assert first == "Best model: poly"
    found = accuracy_json(accuracies)["models"]["poly"]["pooled"]["cross_validation"]["3d"]
    assert rest[0].startswith(f"Mean distance to the tape points: {100 * found['mean_m']:.1f} cm (95 % CI ")
    assert f"RMSE {100 * found['rmse_m']:.1f} cm" in rest[0]
    text = "\n".join(rest)
    outliers, errors = text.index("Outliers: measure 5 points again"), text.index("Errors in cm")
    assert outliers < text.index("white_11, error 8.0 cm: 2: it lies right") < errors
    assert outliers < text.index("m5 (6.0 cm)") < text.index("Between rigid and poly, use rigid") < errors
    assert "\x1b" not in text
    assert NAMES[0] in text
    answer = {"model": "poly", "scheme": "cross_validation", "outliers": list(NAMES)}
    assert answer_json(accuracies)["answer"] == answer | found


@pytest.mark.parametrize("truth", [False, True])
@pytest.mark.parametrize("factor", [1.0, 30.0])
def test_answer_of_all_models_fits_a_window(paper: Findings, truth: bool, factor: float) -> None:
    names = {"red": "north_east_corner", "white": "middle", "black": "south_west_corner"}
    accuracies = [rename_cameras(with_suspects(a, 5), names) for a in many_models(paper.accuracies)]
    accuracies = [replace(a, evaluation=scale(a.evaluation, factor)) for a in accuracies if a.evaluation]
    text = printed([with_truth(a) for a in accuracies] if truth else accuracies)
    lines = text.splitlines()
    assert max(map(len, (line.rstrip() for line in lines))) <= 80, text
    assert len(lines) <= 42, text
    assert "…" not in text
    assert text.count("Errors in cm") == 1
    assert all(any(line.startswith(model) for line in lines) for model in ALL_MODELS)
    assert "With known marker heights: rayplane, " in text
    assert ("Against the ground truth: " in text) == truth


def test_figures_are_without_gross_outliers_and_those_with_them_beside(paper: Findings) -> None:
    accuracies = [with_gross_outlier(a) for a in many_models(paper.accuracies)]
    text = printed(accuracies)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80, text
    clean = accuracy_json(many_models(paper.accuracies))["models"]
    found = accuracy_json(accuracies)["models"]
    best = answer_json(accuracies)["answer"]
    model = found[best["model"]]
    mean_m = model["pooled"]["cross_validation"]["3d"]["mean_m"]
    assert model["pooled"] == clean[best["model"]]["pooled"]
    whole = model["with_excluded"]["pooled"]["cross_validation"]["3d"]["mean_m"]
    assert whole == pytest.approx(10 * mean_m)
    assert [row["measurement"] for row in model["excluded"]] == ["gross_1"]
    assert (best["mean_m"], best["excluded"], best["outliers"][0]) == (mean_m, ["gross_1"], "gross_1")
    assert best["mean_with_excluded_m"] == pytest.approx(10 * mean_m)
    words = " ".join(text.split())
    assert f"Mean distance to the tape points: {100 * mean_m:.1f} cm" in words
    assert (
        "The errors and the advice are without the gross outlier gross_1. With it, the mean error is "
        f"{1000 * mean_m:.1f} cm."
    ) in words
    assert "gross_1, error 200.0 cm: they look exchanged." in words
    assert "3D, all points" in words


def test_tracks_name_the_instants_that_count(paper: Findings) -> None:
    (accuracy,) = only(paper, "rigid").accuracies
    assert accuracy.evaluation is not None
    near, far, every = (
        error_statistics(np.full(n, m), False) for n, m in ((228, 0.001), (292, 0.05), (520, 0.029))
    )
    tracks = TrackErrors(near, near, 228, 520, (far, far), (every, every))
    told = replace(accuracy, evaluation=replace(accuracy.evaluation, model="rayplane"), tracks=tracks)
    words = " ".join(printed([told]).split())
    assert (
        "This is at the 228 of 520 instants at which the marker has the height in the rig. At the other 292, "
        "the mean error is 5.0 cm; over all, it is 2.9 cm."
    ) in words
    found = accuracy_json([told])["models"]["rayplane"]["tracks"]
    assert found["instants"] == {"counted": 228, "all": 520}
    assert found["truth"]["2d"]["mean_m"] == pytest.approx(0.001)
    assert found["other_heights"]["2d"]["count"] == 292
    assert found["all_heights"]["2d"]["mean_m"] == pytest.approx(0.029)


def test_single_model_has_one_row_per_camera(paper: Findings) -> None:
    lines = printed(only(paper, "poly").accuracies).splitlines()
    assert lines[0] == "Model: poly"
    assert {line.split()[0] for line in lines[-4:]} == {"red", "white", "black", "(all)"}


def test_missing_outlier_search_is_not_reported_as_none(paper: Findings) -> None:
    searched = printed([with_suspects(a, 0) for a in only(paper, "poly").accuracies])
    assert "Outliers: none." in searched
    unsearched = " ".join(printed(only(paper, "rigid").accuracies).split())
    assert (
        "Outliers: not searched. The search needs 15 points of a camera, and one of the models poly"
        in unsearched
    )


def test_no_evaluation_gives_an_empty_answer() -> None:
    assert answer_text([]) is None
    assert models_table([]) is None
    assert answer_json([]) == {}


def test_evaluate_prints_the_rest_on_request(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    models = ("--model", "rigid", "--model", "poly")
    short, full = ipsys("evaluate", log, *models), ipsys("evaluate", log, *models, "--details")
    assert short.code == full.code == 0
    assert short.out.startswith("Best model: ")
    assert full.out.startswith(short.out)
    headings = ("held-out points", "Model by the number of points per camera")
    assert [text in short.out for text in headings] == [False, False]
    assert [text in full.out for text in headings] == [True, True]
    assert "--details prints" in short.err
    assert "--details prints" not in full.err
    with Session([log]) as session:
        (accuracy,) = read_accuracy(session, replay([log], Request(models=("poly",)), "evaluate"))
    for row in accuracy.rows(False):
        assert row.error_3d is not None
        assert not row.camera or f"{100 * row.error_3d.max_m:.3f}" in full.out


def test_many_runs_of_a_stage_are_counted(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    models = [word for name in ("rigid", "poly", "rayplane", "best", "kriging") for word in ("--model", name)]
    assert "fit           5 runs computed" in ipsys("fit", log, *models).err
    assert "fit           5 runs up to date" in ipsys("fit", log, *models).err
