"""The files of ``--plots``: the numbers of the JSON, and legible figures."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from matplotlib.text import Text

from ipsys_log.app.report.accuracy import Accuracy, accuracy_json
from ipsys_log.app.report.figures import png
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.paper_figures import (
    cross_validation_csv,
    models_figure,
    paper_csv,
    residuals_figure,
    shown_models,
    write_plots,
)
from ipsys_log.app.report.points_figures import learning_figure, places_figure, published_figure
from ipsys_log.engine.output import write_log
from ipsys_log.messages import Residual
from ipsys_log.statistics.ground_truth import TrajectoryErrors
from tests.conftest import Ipsys
from tests.report.conftest import find, lab_messages, many_models, only, scale, with_accuracies

ALL_FILES = {
    "table_1.csv", "table_2.csv", "cross_validation.csv", "figure_9.png", "figure_10.png", "figure_11.png",
    "learning_curve.png", "errors_floor.png", "models.png",
}  # fmt: skip


def read(content: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(content.decode())))


def test_tables_1_and_2_are_the_figures_of_the_json(paper: Findings) -> None:
    models = accuracy_json(paper.accuracies)["models"]
    for content, kind in ((paper_csv(paper, True), "3d"), (paper_csv(paper, False), "2d")):
        rows = read(content)
        assert [row["method"] for row in rows] == list(models)
        assert [row["paper"] for row in rows] == ["RT", "PR"]
        # The columns have the paper's order, which is that of the rig.
        assert list(rows[0])[2:6] == ["mean_cm_red", "mean_cm_white", "mean_cm_black", "min_cm_red"]
        for row in rows:
            for camera, figures in models[row["method"]]["cameras"].items():
                for name in ("mean", "min", "max", "std"):
                    assert row[f"{name}_cm_{camera}"] == f"{100 * figures[kind][f'{name}_m']:.3f}"


def test_the_table_of_cross_validation_is_the_json(paper: Findings) -> None:
    models = accuracy_json(paper.accuracies)["models"]
    rows = read(cross_validation_csv(paper))
    assert len(rows) == 4 * len(models)
    for row in rows:
        model = models[row["method"]]
        figures = (model["pooled"] if row["camera"] == "all" else model["cameras"][row["camera"]])[
            "cross_validation"
        ]
        assert row["mean_3d_cm"] == f"{100 * figures['3d']['mean_m']:.3f}"
        assert row["mean_high_2d_cm"] == f"{100 * figures['2d']['mean_high_m']:.3f}"
        assert row["bias_z_cm"] == f"{100 * figures['bias_m'][2]:.3f}"
        assert row["within_95"] == f"{figures['within']['95']:.4f}"


# Draws every figure of two models.
@pytest.mark.slow
def test_all_files_are_there_and_differ_between_models(paper: Findings, tmp_path: Path) -> None:
    for model in ("rigid", "poly"):
        assert set(write_plots(only(paper, model), tmp_path / "deep" / model)) == ALL_FILES
        assert {path.name for path in (tmp_path / "deep" / model).iterdir()} == ALL_FILES
    for name in ALL_FILES:
        one, other = ((tmp_path / "deep" / model / name).read_bytes() for model in ("rigid", "poly"))
        # The points are the same for both.
        assert (one == other) == (name == "figure_9.png"), name
        if name.endswith(".png"):
            picture = cv2.imread(str(tmp_path / "deep/poly" / name))
            assert picture is not None
            assert (picture != 255).any(axis=2).mean() > 0.01


@pytest.mark.slow
def test_the_same_log_gives_the_same_bytes(paper: Findings, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        write_plots(only(paper, "poly"), tmp_path / folder)
    for name in ALL_FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_only_available_data_are_drawn(tmp_path: Path) -> None:
    """Without labelled subsets, there are no figures 10 and 11; points at one height have no 3D errors."""
    log = tmp_path / "level.mcap"
    write_log(log, lab_messages(heights=(0.1,)))
    findings = find(log, ("rigid", "best"))
    assert not findings.in_space
    names = write_plots(findings, tmp_path / "plots")
    assert set(names) == ALL_FILES - {"figure_10.png", "figure_11.png"}
    rows = read((tmp_path / "plots/table_1.csv").read_bytes())
    assert {row["mean_cm_red"] for row in rows} == {""}
    assert all(read((tmp_path / "plots/table_2.csv").read_bytes())[0].values())


def test_models_of_a_log_with_ground_truth_are_chosen(paper: Findings) -> None:
    """The errors of their tracks are arrays."""
    errors = TrajectoryErrors("ada", np.zeros((4, 3)), ())
    findings = with_accuracies(
        paper, [replace(accuracy, trajectories=(errors,)) for accuracy in paper.accuracies]
    )
    assert [accuracy.model for accuracy in shown_models(findings)] == [a.model for a in shown_models(paper)]


def texts_of(figure: Figure) -> dict[Text, tuple[float, float, float, float]]:
    """Return each visible text and its box in the figure."""
    png(figure, 100)  # the ticks get their texts during the drawing
    hidden = _hidden_ticks(figure)
    boxes = {}
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if text.get_text().strip() and text.get_visible() and text not in hidden:
            box = text.get_window_extent()
            boxes[text] = (box.x0, box.y0, box.x1, box.y1)
    return boxes


def _hidden_ticks(figure: Figure) -> set[Text]:
    """Return the texts of ticks beyond the ends of their axis."""
    hidden = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis, getattr(axes, "zaxis", axes.xaxis)):
            low, high = sorted(axis.get_view_interval())
            for tick in axis.get_major_ticks():
                if not low - 1e-9 <= tick.get_loc() <= high + 1e-9:
                    hidden |= {tick.label1, tick.label2}
    return hidden


@pytest.mark.parametrize("models", [1, 11])
@pytest.mark.parametrize("name", ["places", "published", "learning", "residuals", "models"])
def test_no_text_covers_another_or_leaves_the_picture(paper: Findings, name: str, models: int) -> None:
    findings = with_accuracies(paper, many_models(paper.accuracies)[-models:])
    figure = {
        "places": places_figure,
        "published": lambda f: published_figure(f, True),
        "learning": learning_figure,
        "residuals": residuals_figure,
        "models": models_figure,
    }[name](findings)
    boxes = texts_of(figure)
    width, height = (figure.get_size_inches() * figure.dpi).tolist()
    outside = [
        t.get_text()
        for t, b in boxes.items()
        if b[0] < -1 or b[2] > width + 1 or b[1] < -1 or b[3] > height + 1
    ]
    assert outside == []
    for (one, a), (other, b) in combinations(boxes.items(), 2):
        across, along = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
        assert across < 1 or along < 2, (one.get_text(), other.get_text())


def test_bad_folders_are_refused_before_anything_is_done(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    before = log.read_bytes()
    (tmp_path / "file").write_text("mine")
    # No user can create a file in /proc.
    elsewhere = [Path("/proc/plots")] if Path("/proc").is_dir() else []
    for target in (tmp_path / "file", tmp_path / "file" / "in_it", log, *elsewhere):
        done = ipsys("evaluate", log, "--model", "rigid", "--plots", target)
        assert done.code == 1
        assert done.out == ""
        assert len(done.err.splitlines()) == 1
        assert "--plots" in done.err
    done = ipsys("replay", log, "--model", "rigid", "--plot", log)
    assert done.code == 1
    assert "is not a figure file" in done.err
    assert log.read_bytes() == before
    assert (tmp_path / "file").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"lab.mcap", "file"}


def test_a_folder_in_the_way_leaves_the_other_files_as_they_were(ipsys: Ipsys, tmp_path: Path) -> None:
    log, plots = tmp_path / "lab.mcap", tmp_path / "plots"
    write_log(log, lab_messages())
    (plots / "models.png").mkdir(parents=True)
    done = ipsys("evaluate", log, "--model", "rigid", "--plots", plots)
    assert done.code == 1
    assert "models.png: is a folder" in done.err
    assert [path.name for path in plots.iterdir()] == ["models.png"]


def test_log_without_points_is_refused_and_no_file_is_written(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "few.mcap"
    write_log(log, lab_messages(count=4))
    for command in (("evaluate", log, "--plots", tmp_path / "plots"), ("report", log)):
        done = ipsys(*command)
        assert done.code == 1
        assert len(done.err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["few.mcap"]


@pytest.mark.slow
def test_evaluate_writes_them(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    done = ipsys(
        "evaluate", log, "--model", "poly", "--model", "best", "--plots", tmp_path / "plots", "--json"
    )
    assert done.code == 0, done.err
    found = json.loads(done.out)
    assert found["recommendation"]["by_places"]
    assert found["recommendation"]["sentences"]
    assert (tmp_path / "plots/models.png").stat().st_size > 1000
    assert f"{tmp_path / 'plots'} has table_1.csv" in done.err


def test_learning_curve_marks_are_at_their_number_of_points(paper: Findings) -> None:
    findings = with_accuracies(paper, many_models(paper.accuracies))
    for figure in (learning_figure(findings), published_figure(findings, True)):
        for axes in figure.axes:
            marked = [line for line in axes.lines if line.get_marker() != "None"]
            assert len(marked) == len(findings.accuracies)
            for line in marked:
                places = np.asarray(line.get_xdata(), float)
                assert np.array_equal(places, places.round())
                assert line.get_transform() == axes.transData


def test_residual_maps_of_two_models_share_their_scales(paper: Findings) -> None:
    poly = next(accuracy for accuracy in paper.accuracies if accuracy.model == "poly")
    assert poly.evaluation is not None
    rows = tuple(replace(row, residuals=tuple(map(shrink, row.residuals))) for row in poly.evaluation.cameras)
    better = replace(scale(poly.evaluation, 0.2), model="best")
    better = replace(better, cameras=tuple(
        replace(row, residuals=of.residuals) for row, of in zip(better.cameras, rows, strict=True)
    ))  # fmt: skip
    figure = residuals_figure(with_accuracies(paper, [poly, Accuracy("best", better, None)]))
    left, right = (axes for axes in figure.axes if axes.get_title(loc="left"))
    assert left.get_xlim() == right.get_xlim()
    assert left.get_ylim() == right.get_ylim()
    arrows = [next(part for part in axes.collections if isinstance(part, Quiver)) for axes in (left, right)]
    assert arrows[0].scale == arrows[1].scale
    assert arrows[0].get_clim() == arrows[1].get_clim()
    assert left.get_title(loc="left").splitlines()[1] == right.get_title(loc="left").splitlines()[1]


def shrink(residual: Residual) -> Residual:
    """Return the residual with a fifth of its error."""
    error_m = residual.predicted_m - residual.world_m
    return replace(residual, predicted_m=residual.world_m + 0.2 * error_m)
