"""The figure of a session: complete, legible, of the right size, for all data."""

import io
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.app.report.errors_figure import count_rows, draw_errors
from ipsys_log.app.report.floor_figure import FloorData, draw_floor, draw_session, read_floor
from ipsys_log.app.report.styles import camera_styles
from ipsys_log.engine.output import write_log
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CameraEvaluation,
    ErrorStatistics,
    Evaluation,
    Floor,
    Measurement,
    Message,
    ReferencePoint,
    Residual,
    Rig,
    RigMarker,
    Run,
    Track,
    Tracks,
    WorldPoint,
)
from ipsys_log.statistics.accuracy import error_statistics
from ipsys_log.statistics.ground_truth import TrackErrors

RIG = Rig(
    "lab", "DICT_4X4_100", 0.2, reference_points=(ReferencePoint("A", 1.2, 2.4),), floor=Floor(4.88, 4.88)
)
MODELS = ("rigid", "poly", "rigid+poly", "ann", "rigid+ann", "gp", "rigid+gp", "kriging", "rigid+kriging")
T0 = 1_700_000_000_000_000_000


def evaluation(
    model: str, cameras: tuple[str, ...], truth: bool = False, scale_m: float = 0.01
) -> Evaluation:
    generator = np.random.default_rng(7)
    rows = []
    for camera in cameras:
        places_m = generator.uniform(0.3, 4.5, (10, 3))
        for against in ("tape", "truth") if truth else ("tape",):
            errors_m = generator.normal(0, scale_m, (10, 3))
            residuals = tuple(
                Residual(f"m{n}", place, place + error)
                for n, (place, error) in enumerate(zip(places_m, errors_m, strict=True))
            )
            spread = error_statistics(np.linalg.norm(errors_m, axis=1))
            flat = error_statistics(np.linalg.norm(errors_m[:, :2], axis=1))
            rows.append(CameraEvaluation(camera, against, spread, flat, residuals))
    return Evaluation(T0, model, tuple(rows))


def accuracy(
    model: str, cameras: tuple[str, ...] = ("red", "white", "black"), truth: bool = False
) -> Accuracy:
    both = (ErrorStatistics(500, 0.012, 0.001, 0.16, 0.011), ErrorStatistics(500, 0.01, 0.001, 0.12, 0.01))
    tracks = TrackErrors(*both, 500, 500, None, both)
    name = model.replace("+", "_")
    return Accuracy(name, evaluation(model, cameras, truth), tracks if truth else None)


def messages(rig: Rig | None, moving: bool, truth: bool) -> list[Message]:
    found = [Message("/rig", T0, T0, rig)] if rig else []
    for n in range(12):
        place = Measurement(
            T0,
            f"m{n}",
            marker_id=0,
            point=WorldPoint(0.4 * n, 2.0, 0.1),
            splits=("test" if n < 10 else "train",),
        )
        found.append(Message("/measurements", T0, T0, place))
    for n in range(50) if moving else ():
        time_ns = T0 + 100_000_000 * n
        tracks = Tracks(time_ns, (Track("robot_0", 0, 1 + 0.05 * n, 2 + 0.02 * n, 0.1),))
        found.append(Message("/runs/poly/tracks", time_ns, time_ns, tracks))
        if truth:
            found.append(Message("/truth/tracks", time_ns, time_ns, tracks))
    end_ns = found[-1].log_time_ns
    return [*found, Message("/runs/poly/record", end_ns, end_ns, Run(end_ns, "poly", "fuse", number=1))]


@pytest.mark.parametrize(
    ("models", "moving", "truth"),
    [((), True, False), (MODELS[:1], False, False), (MODELS[:2], True, True), (MODELS, True, True)],
)
def test_figure_is_drawn_for_all_kinds_of_data(
    models: tuple[str, ...], moving: bool, truth: bool, tmp_path: Path
) -> None:
    write_log(tmp_path / "lab.mcap", messages(RIG, moving, truth))
    with Session([tmp_path / "lab.mcap"]) as session:
        draw_session(session, [accuracy(model, truth=truth) for model in models], tmp_path / "lab.png")
    picture = cv2.imread(str(tmp_path / "lab.png"))
    assert picture is not None
    height, width = picture.shape[:2]
    assert width == (1400 if models else 730)
    if models:  # the errors beside the map are as high as the map
        assert (picture[int(0.75 * height) : int(0.85 * height), 800:] != 255).any()
    assert 800 <= height <= (800 if len(models) < 3 else 1900)
    assert (picture != 255).any(axis=2).mean() > 0.01
    assert {path.name for path in tmp_path.iterdir()} == {"lab.mcap", "lab.png"}


def test_figure_without_a_rig_shows_points_and_tracks(tmp_path: Path) -> None:
    write_log(tmp_path / "lab.mcap", messages(None, True, False))
    with Session([tmp_path / "lab.mcap"]) as session:
        draw_session(session, [], tmp_path / "lab.png")
    assert (tmp_path / "lab.png").stat().st_size > 1000


def test_robot_with_two_markers_has_the_lines_of_both(tmp_path: Path) -> None:
    rig = replace(RIG, markers=(RigMarker(0, robot="ada"), RigMarker(1, robot="ada")))
    tracks = [Track("ada", n % 2, 1.0 + n % 2, 2 + 0.02 * n, 0.1) for n in range(10)]
    written = [Message("/rig", T0, T0, rig)]
    for n, track in enumerate(tracks):
        time_ns = T0 + 100_000_000 * n
        written.append(Message("/runs/poly/tracks", time_ns, time_ns, Tracks(time_ns, (track,))))
    written.append(Message("/runs/poly/record", time_ns, time_ns, Run(time_ns, "poly", "fuse", number=1)))
    write_log(tmp_path / "lab.mcap", written)
    with Session([tmp_path / "lab.mcap"]) as session:
        lines = read_floor(session, []).tracks
    np.testing.assert_array_equal(lines["ada"][:, 0], [1, 1, 1, 1, 1, np.nan, 2, 2, 2, 2, 2])


def test_log_without_data_to_draw_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path / "lab.mcap", [Message("/rig", T0, T0, replace(RIG, floor=None))])
    with Session([tmp_path / "lab.mcap"]) as session, pytest.raises(IpsysError, match="nothing to draw"):
        draw_session(session, [], tmp_path / "lab.png")
    assert not (tmp_path / "lab.png").exists()


@pytest.mark.parametrize(
    ("count", "cameras", "truth"),
    [
        (1, ("red",), False),
        (3, ("red", "white", "black"), True),
        (9, ("red", "white", "black"), True),
        (9, ("north_east_corner", "south"), False),
    ],
)
def test_no_text_covers_another_or_leaves_the_picture(
    count: int, cameras: tuple[str, ...], truth: bool
) -> None:
    accuracies = [accuracy(model, cameras, truth) for model in MODELS[-count:]]
    figure = Figure(figsize=(14, max(8.0, 1.6 + 0.23 * count_rows(accuracies))), dpi=100)
    draw_errors(figure, accuracies, camera_styles(cameras), left_in=7.3, top_in=0.65)
    width, height = figure.get_size_inches() * figure.dpi
    figure.savefig(io.BytesIO(), format="png")  # ticks get their texts during the drawing
    (axes,) = figure.axes
    ticks = [
        tick
        for tick in axes.xaxis.get_major_ticks()
        if not axes.viewLim.intervalx[0] <= tick.get_loc() <= axes.viewLim.intervalx[1]
    ]
    beyond = {label for tick in ticks for label in (tick.label1, tick.label2)}
    texts = [text for text in figure.findobj(Text) if isinstance(text, Text) and text.get_text().strip()]
    boxes = {text: text.get_window_extent() for text in texts if text.get_visible() and text not in beyond}
    for one, other in combinations(boxes, 2):
        a, b = boxes[one], boxes[other]
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        along = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert across < 1 or along < 2, (one.get_text(), other.get_text())
    # The floor is on the left of the panel.
    outside = [
        t.get_text() for t, b in boxes.items() if b.x0 < 725 or b.x1 > width or b.y0 < 0 or b.y1 > height
    ]
    assert outside == []


@pytest.mark.parametrize(("scale_m", "factor"), [(0.001, 200), (0.01, 20), (0.5, None)])
def test_arrows_are_exaggerated_by_the_factor_that_is_stated(scale_m: float, factor: int | None) -> None:
    found = evaluation("poly", ("red",), scale_m=scale_m)
    axes: Axes = Figure().add_subplot()
    draw_floor(axes, FloorData(RIG, [], "poly", found, {}, {}), camera_styles(["red"]))
    title = axes.get_title(loc="left")
    assert title == "Errors of poly at held-out points" + (
        f", arrows {factor} times true length" if factor else ""
    )
    (arrows,) = [artist for artist in axes.collections if hasattr(artist, "scale")]
    assert arrows.scale == pytest.approx(1 / (factor or 1))


def test_cameras_are_apart_and_seen_on_white() -> None:
    styles = camera_styles(["red", "white", "black", "a", "b", "c", "d"])
    assert len({colour for colour, _ in styles.values()}) == 7
    assert len({shape for _, shape in styles.values()}) == 7
    for colour, _ in styles.values():
        assert min(int(colour[i : i + 2], 16) for i in (1, 3, 5)) < 0xA0
