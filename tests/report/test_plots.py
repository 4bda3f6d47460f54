"""The files of ``--plot`` into a folder: the numbers of the JSON, and legible figures."""

import base64
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
from matplotlib.patches import Ellipse
from matplotlib.quiver import Quiver
from matplotlib.text import Text

from ipsys_log.app.report.accuracy import Accuracy, accuracy_json
from ipsys_log.app.report.drive_figures import DrawnTrack, draw_tracks, read_drawn_tracks
from ipsys_log.app.report.figures import png
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.html_figures import overlap_pictures
from ipsys_log.app.report.html_sections import overlap_tables
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
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Floor, Message, Residual, Rig, Track, Tracks
from ipsys_log.messages.channels import TRACKS
from ipsys_log.statistics.disagreement import CameraPositions, PairDisagreement, compare_cameras
from ipsys_log.statistics.ground_truth import TrajectoryErrors
from ipsys_log.units import NS_PER_S
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
        done = ipsys("evaluate", log, "--model", "rigid", "--plot", target)
        assert done.code == 1
        assert done.out == ""
        assert len(done.err.splitlines()) == 1
        assert "--plot" in done.err
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
    done = ipsys("evaluate", log, "--model", "rigid", "--plot", plots)
    assert done.code == 1
    assert "models.png: is a folder" in done.err
    assert [path.name for path in plots.iterdir()] == ["models.png"]


def test_log_without_points_is_refused_and_no_file_is_written(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "few.mcap"
    write_log(log, lab_messages(count=4))
    for command in (("evaluate", log, "--plot", tmp_path / "plots"), ("report", log)):
        done = ipsys(*command)
        assert done.code == 1
        assert len(done.err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["few.mcap"]


@pytest.mark.slow
def test_evaluate_writes_them(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    done = ipsys(
        "evaluate", log, "--model", "poly", "--model", "best", "--plot", tmp_path / "plots", "--json"
    )
    assert done.code == 0, done.err
    found = json.loads(done.out)
    assert found["recommendation"]["by_places"]
    assert found["recommendation"]["sentences"]
    assert (tmp_path / "plots/models.png").stat().st_size > 1000
    assert f"{tmp_path / 'plots'} has table_1.csv" in done.err


def test_plot_is_a_file_a_folder_or_a_format_of_a_folder(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    plots = [word for to in ("floor.svg", "pdf/*.pdf") for word in ("--plot", tmp_path / to)]
    assert ipsys("evaluate", log, "--model", "rigid", *plots, "--plots", tmp_path / "png").code == 0
    assert (tmp_path / "floor.svg").read_bytes().startswith(b"<?xml")
    names = {suffix: {path.name for path in (tmp_path / suffix).iterdir()} for suffix in ("pdf", "png")}
    assert "models.png" in names["png"] >= {"table_1.csv"}
    assert names["pdf"] == {name.replace(".png", ".pdf") for name in names["png"]}
    assert (tmp_path / "pdf/models.pdf").read_bytes().startswith(b"%PDF")


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


EPOCH_NS, STEP_NS = 1_700_000_000_000_000_000, 50_000_000


def write_tracks(path: Path) -> None:
    """Write a robot that drives 1 m along x; from its middle on, another camera sees it."""
    messages = []
    for n in range(21):
        time_ns = EPOCH_NS + n * STEP_NS + (n > 15) * 10 * STEP_NS
        cameras = ("red",) if n < 10 else ("white",)
        track = Track("ada", 3, 0.05 * n, 2.0, 0.1, 0.0, 4e-6 * np.eye(3), cameras, True)
        messages.append(Message(TRACKS.topic_of("poly"), time_ns, time_ns, Tracks(time_ns, (track,))))
    write_log(path, iter(messages))


def test_drawn_track_has_breaks_regions_and_hand_overs(tmp_path: Path) -> None:
    write_tracks(tmp_path / "drive.mcap")
    with Session([tmp_path / "drive.mcap"]) as session:
        tracks = read_drawn_tracks(session, "poly")
    ada = tracks["ada"]
    assert np.isnan(ada.line_m[:, 0]).nonzero()[0].tolist() == [16]
    assert ada.hand_overs_m.tolist() == [[0.5, 2.0]]
    assert np.diff(ada.regions[0][:, 0]).min() > 0.15
    axes = Figure().add_subplot()
    enlarged = draw_tracks(axes, tracks)
    # The region of 95 % has a radius of 4.9 mm: ten times that is visible, twenty times is too large.
    assert enlarged == 10
    ellipse = axes.patches[0]
    assert isinstance(ellipse, Ellipse)
    np.testing.assert_allclose(ellipse.get_width() / enlarged, 2 * np.sqrt(-2 * np.log(0.05)) * 0.002)


def test_log_without_tracks_has_none_to_draw(tmp_path: Path) -> None:
    write_tracks(tmp_path / "drive.mcap")
    with Session([tmp_path / "drive.mcap"]) as session:
        assert read_drawn_tracks(session, "best") == {}
    assert draw_tracks(Figure().add_subplot(), {}) >= 1


def test_tracks_of_many_robots_look_different() -> None:
    line_m, none_m = np.array([[0.0, 0.0], [1.0, 1.0]]), (np.empty((0, 2)), np.empty((0, 2, 2)))
    tracks = {f"robot_{n}": DrawnTrack(line_m, none_m, np.empty((0, 2))) for n in range(20)}
    axes = Figure().add_subplot()
    draw_tracks(axes, tracks)
    lines = [line for line in axes.lines if str(line.get_label()).startswith("robot")]
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 20


def pairs(
    sigma_m: float | None, cameras: tuple[str, str] = ("red", "white"), apart_m: float = 0.005
) -> list[PairDisagreement]:
    """Return two cameras that differ in x, with a stated standard deviation."""
    times_ns = np.arange(200) * NS_PER_S // 30
    points_m = np.column_stack([1 + times_ns / NS_PER_S * 0.3, np.full(200, 2.0)])
    covariances = np.broadcast_to((np.nan if sigma_m is None else sigma_m**2) * np.eye(2), (200, 2, 2))
    ids = np.zeros(200, dtype=np.int64)
    return compare_cameras(
        [
            CameraPositions(cameras[0], ids, times_ns, points_m + np.array([apart_m, 0.0]), covariances),
            CameraPositions(cameras[1], ids, times_ns, points_m, covariances),
        ]
    )


@pytest.mark.parametrize(
    ("sigma_m", "within", "verdict"),
    [(0.005, "100 %", "consistent"), (0.001, "0 %", "larger than the covariances explain"), (None, "-", "-")],
)
def test_row_says_whether_covariances_explain_it(sigma_m: float | None, within: str, verdict: str) -> None:
    table = overlap_tables(pairs(sigma_m))["table"]
    assert table is not None
    (row,) = table.cells
    assert row == ["red and white", "199", "5.0", "5.0", within, verdict]


@pytest.mark.parametrize("rig", [None, Rig("lab", "DICT_4X4_100", 0.2, floor=Floor(4.88, 4.88))])
def test_panel_has_a_map_and_a_time_course(rig: Rig | None) -> None:
    shown = overlap_pictures(pairs(0.005), rig)
    assert ["over the floor" in one["caption"] for one in shown] == [True, False]
    for one in shown:
        assert b"</svg>" in base64.b64decode(one["uri"].partition(",")[2])
    assert shown == overlap_pictures(pairs(0.005), rig)


def test_page_shows_the_pairs_that_differ_most_and_folds_all() -> None:
    many = [pair for n in range(12) for pair in pairs(0.005, ("a", f"b{n}"), n / 1000)]
    tables = overlap_tables(many)
    assert tables["table"] is not None
    assert tables["all"] is not None
    assert [row[0] for row in tables["table"].cells] == [f"a and b{n}" for n in range(11, 1, -1)]
    assert [row[0] for row in tables["all"].cells] == [f"a and b{n}" for n in range(12)]
    assert overlap_tables(many[:3])["all"] is None
