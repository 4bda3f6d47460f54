"""Time series of a recording for Rerun: disagreement of cameras, latency, and the plots that show them."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Event, Latency, Message, Position, Positions, Run
from ipsys_log.sinks.rerun.recording import write_recording

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
COUNT = 20
MS = 1_000_000


def messages(cameras: Sequence[str]) -> Iterator[Message]:
    """A robot at 1 m/s along x; the second camera is 20 ms late, and shifts positions by 3 and 4 mm."""
    for n in range(COUNT):
        for number, camera in enumerate(cameras):
            time_ns = START_NS + n * STEP_NS + 20 * MS * number
            along_m = (time_ns - START_NS) / 1e9
            position = Position(7, 1 + along_m + 0.003 * number, 2 + 0.004 * number, 0.1)
            topic = f"/runs/poly/cameras/{camera}/positions"
            yield Message(topic, time_ns + MS, time_ns, Positions(time_ns, (position,)), camera)
            received = time_ns + 5 * MS
            steps = [received + delay * MS for delay in (4, 5, 6, 7 + n)]
            latency = Latency(time_ns, camera, received, *steps)
            yield Message("/latency", time_ns + 2 * MS, time_ns, latency)
    end_ns = START_NS + COUNT * STEP_NS
    for number, stage in enumerate(("locate", "fuse"), 1):
        yield Message("/runs/poly/record", end_ns + number, end_ns, Run(end_ns, "poly", stage, number=number))


def save(path: Path, content: Iterator[Message]) -> Path:
    write_log(path, content)
    with Session([path]) as session:
        write_recording(session, save=path.with_suffix(".rrd"))
    return path.with_suffix(".rrd")


def series(path: Path, entity: str) -> dict[str, list[Any]]:
    """Return the values of a series, and its times in ns by timeline."""
    for chunk in RrdReader(path).stream().to_chunks():
        if chunk.entity_path == entity and chunk.timeline_names:
            batch = chunk.to_record_batch()
            times = {name: batch.column(name).cast("int64").to_pylist() for name in chunk.timeline_names}
            return {**times, "values": [row[0] for row in batch.column("Scalars:scalars").to_pylist()]}
    raise AssertionError(f"{entity} is not in the recording")


def shown_views(path: Path) -> str:
    """Return the text of the stored layout."""
    (blueprint,) = RrdReader(path).blueprints()
    chunks = RrdReader(path).stream(store=blueprint).to_chunks()
    return "\n".join(str(chunk.to_record_batch().to_pydict()) for chunk in chunks)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("series") / "lab.mcap", messages(("red", "white")))


def test_disagreement_is_the_shift_between_the_cameras(saved: Path) -> None:
    """The clocks differ by 20 ms, in which the robot moves 2 cm; the shift is 5 mm."""
    points = series(saved, "/series/disagreement/poly/red_and_white")
    # The first sighting has none of the other camera before it.
    assert points["publish_time"] == [START_NS + n * STEP_NS for n in range(1, COUNT)]
    np.testing.assert_allclose(points["values"], 5.0, atol=1e-9)


def test_latency_is_the_time_from_arrival_to_publication(saved: Path) -> None:
    for camera in ("red", "white"):
        points = series(saved, f"/series/latency/{camera}")
        assert points["values"] == [7.0 + n for n in range(COUNT)]
        delays_ns = np.subtract(points["log_time"], points["publish_time"])
        assert set(delays_ns.tolist()) == {2 * MS}


def test_layout_has_plots_with_legends(saved: Path) -> None:
    views = shown_views(saved)
    for text in ("Disagreement of cameras, mm", "Latency, ms", "PlotLegend", "Legend", "Floor"):
        assert text in views
    names = [chunk.entity_path for chunk in RrdReader(saved).stream().to_chunks()]
    assert "/legend" in names


def test_layout_without_series_has_no_plots(tmp_path: Path) -> None:
    alone = (message for message in messages(("red",)) if message.topic != "/latency")
    views = shown_views(save(tmp_path / "lab.mcap", alone))
    assert "Floor" in views
    assert "Disagreement" not in views
    assert "Latency" not in views


def test_an_event_of_the_log_stays_beside_the_legend(tmp_path: Path) -> None:
    event = Message("/events", START_NS, START_NS, Event(START_NS, "camera_lost", "red is gone", "red"))
    views = shown_views(save(tmp_path / "lab.mcap", iter([event, *messages(("red", "white"))])))
    assert "Events" in views
    assert "Legend" in views
