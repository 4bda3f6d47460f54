"""The Rerun layout of a hall in the saved recording: whole frames, visible symbols, the whole floor."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rerun.chunk import RrdReader

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CompressedImage,
    Distance,
    Floor,
    Measurement,
    Message,
    Position,
    Positions,
    ReferencePoint,
    Rig,
    Run,
    Track,
    Tracks,
)
from ipsys_log.sinks.rerun.recording import write_recording
from ipsys_log.sinks.rerun.scene import Plot, layout
from tests.geometry.squares import FISHEYE
from tests.sinks.test_rerun_recording import START_NS, STEP_NS, jpeg

LAB, HALL = Floor(4.0, 5.0), Floor(20.0, 15.0)
POINTS = (ReferencePoint("A", 1.0, 2.0), ReferencePoint("B", 3.0, 2.0))
FACTOR = 4.0  # the hall is four times as large as the lab
# Rerun's default: the angle of the smaller side of a view.
VIEW_RAD = math.radians(55.0)


def saved(folder: Path, floor: Floor) -> Path:
    log, path = folder / "log.mcap", folder / "log.rrd"
    write_log(log, _messages(Rig("rig", "DICT_4X4_100", 0.2, reference_points=POINTS, floor=floor)))
    with Session([log]) as session:
        write_recording(session, save=path)
    return path


def _messages(rig: Rig) -> Iterator[Message]:
    yield Message("/rig", START_NS, START_NS, rig)
    yield Message("/cameras/red/calibration", START_NS, START_NS, FISHEYE, "red")
    distances = (Distance("A", 1.5), Distance("B", 1.5))
    measurement = Measurement(START_NS, "m1", marker_id=0, distances=distances, side="left", height_m=0.1)
    yield Message("/measurements", START_NS, START_NS, measurement)
    for number in range(2):
        time_ns = START_NS + number * STEP_NS
        for camera in ("red", "white"):
            image = CompressedImage(time_ns, camera, jpeg(100), "jpeg")
            yield Message(f"/cameras/{camera}/image", time_ns, time_ns, image, camera)
        positions = Positions(time_ns, (Position(0, 1.0, 2.0, 0.1),))
        yield Message("/runs/poly/cameras/red/positions", time_ns, time_ns, positions, "red")
        tracks = Tracks(time_ns, (Track("robot_0", 0, 1.0, 2.0, 0.1, 0.5),))
        yield Message("/runs/poly/tracks", time_ns, time_ns, tracks)
    yield Message("/runs/poly/record", time_ns, time_ns, Run(time_ns, "poly", "fuse", number=1))


def values(path: Path, column: str, of_blueprint: bool = False) -> dict[str, list[Any]]:
    """Return the values of a component by entity: the first ones of each entity."""
    reader = RrdReader(path)
    stream = reader.stream(store=reader.blueprints()[0]) if of_blueprint else reader.stream()
    firsts: dict[str, list[Any]] = {}
    for chunk in stream.to_chunks():
        batch = chunk.to_record_batch()
        if column in batch.schema.names and batch.column(column).to_pylist()[0]:
            firsts.setdefault(chunk.entity_path, batch.column(column).to_pylist()[0])
    return firsts


def test_symbols_of_a_hall_are_larger(tmp_path: Path) -> None:
    radii = {}
    for name, floor in {"lab": LAB, "hall": HALL}.items():
        (tmp_path / name).mkdir()
        path = saved(tmp_path / name, floor)
        points, arrows = (values(path, f"{kind}:radii") for kind in ("Points3D", "Arrows3D"))
        of_runs = {entity: radii for entity, radii in arrows.items() if entity.startswith("/world/runs/")}
        radii[name] = {**points, **of_runs}
        lengths = values(path, "Arrows3D:vectors")["/world/runs/poly/robots/robot_0/heading"]
        radii[name]["heading"] = [math.hypot(*lengths[0])]
    assert len(radii["lab"]) == 6  # robot, arrow, its length, position, calibration point, reference points
    for entity, lab in radii["lab"].items():
        assert radii["hall"][entity] == pytest.approx([FACTOR * radius for radius in lab]), entity


def test_tile_of_a_camera_shows_the_frame_and_no_more(tmp_path: Path) -> None:
    """The camera without intrinsics keeps the bounds of its content."""
    path = saved(tmp_path, HALL)
    (bounds,) = values(path, "VisualBounds2D:range", of_blueprint=True).values()
    assert bounds == [{"x_range": [0.0, FISHEYE.width], "y_range": [0.0, FISHEYE.height]}]


@pytest.mark.parametrize("floor", [LAB, HALL, Floor(40.0, 8.0), Floor(6.0, 30.0)], ids=str)
def test_eye_sees_the_whole_floor_and_little_more(floor: Floor, tmp_path: Path) -> None:
    path = saved(tmp_path, floor)
    (eye,) = values(path, "EyeControls3D:position", of_blueprint=True).values()
    ((x_m, y_m, height_m),) = eye
    assert (x_m, y_m) == (floor.width_m / 2, floor.depth_m / 2)
    # The view is wider than high by a third, in a window of 1440 x 900.
    seen_m = 2 * height_m * math.tan(VIEW_RAD / 2)
    shares = floor.depth_m / seen_m, floor.width_m / (1.33 * seen_m)
    assert 0.8 < max(shares) < 0.97


def test_legend_of_many_series_does_not_hide_them() -> None:
    def is_visible(series: int) -> bool:
        blueprint: Any = layout([], [], None, False, {"series/of": Plot("Disagreement, mm", series)})
        _, plot, _ = blueprint.root_container.contents
        visible: list[bool] = plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist()
        return visible[0]

    assert is_visible(3)
    assert not is_visible(100)
