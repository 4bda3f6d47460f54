"""The state of the dashboard: messages as input, the JSON of the pages as output."""

import asyncio
import json
import math
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.app.web.dashboard.app import Feed
from ipsys_log.app.web.dashboard.map import describe_floor
from ipsys_log.app.web.dashboard.pictures import shrink
from ipsys_log.app.web.dashboard.status import RecentEvents
from ipsys_log.messages import CameraCalibration, CameraModel, CompressedImage, Model, Pair
from ipsys_log.sinks.video.floor_map import covariance_ellipse
from ipsys_log.units import NS_PER_S
from tests.stages.drawing import jpeg
from tests.web.dashboards import (
    BEGIN_NS,
    RIG,
    TILTED,
    LiveLab,
    event,
    frame,
    latency,
    markers,
    positions,
    robot,
    tracks,
)

LENS = CameraCalibration(
    0, "red", 1000, 600, "plumb_bob", np.zeros(5), np.array([[500.0, 0, 499.5], [0, 500, 299.5], [0, 0, 1]])
)


@pytest.fixture
def lab(tmp_path: Path) -> LiveLab:
    return LiveLab(tmp_path / "monday.mcap")


@given(st.lists(st.floats(-0.3, 0.3), min_size=4, max_size=4))
def test_ellipse_has_the_axes_of_the_covariance(values: list[float]) -> None:
    root = np.array(values).reshape(2, 2)
    covariance_m2 = root @ root.T
    long_m, short_m, angle = covariance_ellipse(covariance_m2)
    variances = np.linalg.eigvalsh(covariance_m2)[::-1]
    # In two dimensions, the quantile of chi-squared is -2 ln(1 - p).
    expected = np.sqrt(np.maximum(variances, 0) * -2 * math.log(0.05))
    assert np.allclose([long_m, short_m], expected, atol=1e-7)
    along = np.array([math.cos(angle), math.sin(angle)])
    assert np.allclose(along @ covariance_m2 @ along, variances[0], atol=1e-9)


def test_covariance_without_a_number_gives_no_ellipse(lab: LiveLab) -> None:
    bad = np.full((3, 3), np.nan)
    lab.feed(tracks(BEGIN_NS, robot(0, 1.0, 2.0, covariance_m2=bad), robot(1, math.nan, 2.0)))
    (row,) = lab.dashboard.robots()["robots"]
    assert row["name"] == "robot_0"
    assert "ellipse" not in row


def test_tracks_of_the_shown_run_become_robots(lab: LiveLab) -> None:
    lab.run(2)
    now_ns = lab.time_ns
    lab.feed(
        tracks(now_ns, robot(0, 1.0, 2.0), robot(9, 3.0, 1.0, heading_rad=None)),
        tracks(now_ns, robot(0, 9.0, 9.0), run="rigid"),
        tracks(now_ns - 1, robot(0, 8.0, 8.0)),
        tracks(now_ns, robot(1, 2.0, 2.0, coasting_ns=3 * NS_PER_S, inside=False, cameras=(), **TILTED)),
    )
    data = lab.dashboard.robots()
    assert data["now"] == 2000
    rows = {row["name"]: row for row in data["robots"]}
    first = rows["robot_0"]
    assert [first[key] for key in ("id", "t", "seen", "x", "y", "heading")] == [0, 2000, 2000, 1.0, 2.0, 0.5]
    assert first["ellipse"] == pytest.approx([0.04895, 0.02448, 0.0])
    # A marker without a robot in the rig is less important, and a missing value is a missing key.
    assert "colour" in first
    assert not {"colour", "heading", "outside", "z", "tilt"} & rows["marker_9"].keys()
    assert (rows["robot_1"]["seen"], rows["robot_1"]["outside"]) == (-1000, True)
    assert (rows["robot_1"]["z"], rows["robot_1"]["tilt"]) == (0.1, 0.3)


def test_trail_of_a_new_page_has_ten_seconds(lab: LiveLab) -> None:
    for n in range(300):
        lab.feed(tracks(BEGIN_NS + n * NS_PER_S // 20, robot(0, n / 100, 1.0)))
    trail = lab.dashboard.scene(True)["trails"]["robot_0"]
    assert trail[-1][0] - trail[0][0] == pytest.approx(10_000, abs=100)
    assert {b[0] - a[0] for a, b in pairwise(trail)} == {100}
    assert all(x == pytest.approx(time / 50 / 100, abs=1e-9) for time, x, _ in trail)


def test_robot_that_is_gone_for_a_minute_is_left_out(lab: LiveLab) -> None:
    lab.feed(tracks(BEGIN_NS, robot(0, 1.0, 1.0)))
    lab.run(59)
    assert len(lab.dashboard.robots()["robots"]) == 1
    lab.run(2)
    assert lab.dashboard.robots()["robots"] == []
    assert lab.dashboard.scene(True)["trails"] == {}


def test_events_are_newest_first_with_their_severity(lab: LiveLab) -> None:
    for second, (kind, camera) in enumerate(
        [("camera_lost", "red"), ("frame_skipped", "red"), ("frame_skipped", "white")] * 2
    ):
        lab.feed(event(BEGIN_NS + second * NS_PER_S, kind, f"{kind} {second}", camera))
    lab.feed(event(BEGIN_NS + 70 * NS_PER_S, "frame_skipped", "a\x1b[31m frame", "red"))
    for _ in range(2):
        lab.feed(event(BEGIN_NS + 71 * NS_PER_S, "mark", "same text"))
    shown = lab.dashboard.status()
    assert [(row["kind"], row["camera"], row["count"], row["severity"]) for row in shown["events"]] == [
        ("mark", None, 1, "mark"),
        ("mark", None, 1, "mark"),
        ("frame_skipped", "red", 1, "warning"),
        ("frame_skipped", "white", 2, "warning"),
        ("frame_skipped", "red", 2, "warning"),
        ("camera_lost", "red", 2, "error"),
    ]
    assert shown["events"][2]["text"] == "a\\x1b[31m frame"
    assert {row["name"]: row["skipped"] for row in shown["cameras"]} == {"red": 3, "white": 2}


def test_number_of_events_on_a_page_is_limited() -> None:
    events = RecentEvents()
    for n in range(500):
        events.add(event(n, f"kind_{n}", "text").payload, n)
    assert [row["kind"] for row in events.newest_first()] == [f"kind_{n}" for n in range(499, 449, -1)]


def test_cameras_have_rates_ages_and_warnings(lab: LiveLab) -> None:
    lab.dashboard.status()
    lab.feed(frame(BEGIN_NS + NS_PER_S))
    lab.run(2)
    lab.states["red"].frames += 20
    lab.states["white"].up = False
    lab.states["white"].dropped, lab.states["white"].missed = 2, 3
    red, white = lab.dashboard.status()["cameras"]
    assert (red["state"], red["rate_hz"], red["age_ms"], red["delay_ms"]) == ("up", 10.0, 1000, 4.0)
    assert red["warnings"] == ["the image is blurred: add light"]
    assert (white["state"], white["dropped"], white["rate_hz"]) == ("lost", 5, 0.0)
    assert "age_ms" not in white


def test_recording_has_its_size_and_the_time_that_the_disk_lasts(lab: LiveLab, tmp_path: Path) -> None:
    assert lab.dashboard.status()["recording"] == {"file": "monday.mcap", "seconds": 0.0}
    (tmp_path / "monday.mcap").write_bytes(b"x" * 1000)
    lab.run(10)
    recording = lab.dashboard.status()["recording"]
    assert (recording["file"], recording["seconds"], recording["bytes"]) == ("monday.mcap", 10.0, 1000)
    assert recording["left_s"] == pytest.approx(recording["free_bytes"] / 100, rel=1e-6)
    assert recording["is_short"] is False


class Stream:
    name, client_count, drops = "VRPN port 3883", 2, SimpleNamespace(count=7)


class Sender:
    name, drops = "UDP 9870", SimpleNamespace(count=0)


def test_streams_have_their_clients_and_dropped_messages(tmp_path: Path) -> None:
    lab = LiveLab(tmp_path / "log.mcap", streams=[Stream(), Sender()])
    assert lab.dashboard.status()["streams"] == [
        {"name": "VRPN port 3883", "clients": 2, "dropped": 7},
        {"name": "UDP 9870", "dropped": 0},
    ]


def test_latencies_and_disagreement_are_those_of_the_messages(lab: LiveLab) -> None:
    for n in range(30):
        time_ns = BEGIN_NS + n * NS_PER_S // 30
        lab.feed(latency(time_ns), positions(time_ns, "red", 1.0), positions(time_ns + 1000, "white", 1.003))
    lab.run(2)
    shown = lab.dashboard.status()
    steps = {row["step"]: (row["median_ms"], row["p99_ms"]) for row in shown["latency"]}
    assert steps == {
        "received": (5.0, 5.0),
        "detected": (10.0, 10.0),
        "located": (1.0, 1.0),
        "fused": (2.0, 2.0),
        "published": (1.0, 1.0),
        "total": (14.0, 14.0),
    }
    assert shown["overlap"] == ["positions of cameras red and white differ by 3.0 mm (median), 3.0 mm (p95)"]


def test_tile_shows_a_frame_with_its_own_markers(lab: LiveLab) -> None:
    for n in range(4):  # four frames arrive before the markers of the second one
        lab.feed(frame(BEGIN_NS + n * NS_PER_S // 4))
    second_ns = BEGIN_NS + NS_PER_S // 4
    lab.feed(markers(second_ns, marker_id=7))
    red, white = lab.dashboard.tiles()["cameras"]
    assert red["picture"] == f"picture/red/{second_ns}"
    assert red["size_px"] == [320, 180]
    assert [(row["id"], row["corners_px"][2]) for row in red["markers"]] == [(7, [140.0, 100.0])]
    assert white == {"name": "white", "markers": []}
    shown = lab.dashboard.frame("red", second_ns)
    assert isinstance(shown, CompressedImage)
    assert shown.timestamp == second_ns
    assert lab.dashboard.frame("red", BEGIN_NS) is None
    assert lab.dashboard.frame("none", second_ns) is None


def test_tiles_change_at_most_five_times_per_second(lab: LiveLab) -> None:
    pictures = set()
    for n in range(120):
        time_ns = BEGIN_NS + n * NS_PER_S // 60
        lab.feed(frame(time_ns), markers(time_ns))
        pictures.add(lab.dashboard.tiles()["cameras"][0].get("picture"))
    assert len(pictures - {None}) in (9, 10)


def test_frames_without_results_are_shown_after_some_seconds(lab: LiveLab) -> None:
    for n in range(5):
        lab.feed(frame(BEGIN_NS + n * NS_PER_S))
    red, _ = lab.dashboard.tiles()["cameras"]
    assert red["picture"] == f"picture/red/{BEGIN_NS + 3 * NS_PER_S}"
    assert red["markers"] == []
    assert "size_px" not in red


@pytest.mark.parametrize(("size", "shrunk"), [((1080, 1920), (270, 480)), ((180, 320), (180, 320))])
def test_picture_is_scaled_to_the_size_of_a_tile(size: tuple[int, int], shrunk: tuple[int, int]) -> None:
    grey = np.tile(np.linspace(0, 255, size[1]).astype(np.uint8), (size[0], 1))
    small = simplejpeg.decode_jpeg(shrink(CompressedImage(0, "red", jpeg(grey), "jpeg")), "GRAY")[..., 0]
    assert small.shape == shrunk
    expected = np.linspace(0, 255, shrunk[1])
    assert np.abs(small.mean(axis=0) - expected).max() < 4


def pairs_of_a_level_camera() -> tuple[Pair, ...]:
    """Return pairs of a camera 2 m above (2, 1.5) that looks down, with x as in the world."""
    world_m = [np.array([x, y, z]) for x in (1.0, 3.0) for y in (1.0, 2.0) for z in (0.0, 0.1)]
    turned = np.diag([1.0, -1.0, -1.0])
    origin_m = np.array([2.0, 1.5, 2.0])
    return tuple(Pair(f"p{n}", n, turned @ (w - origin_m), w, 10) for n, w in enumerate(world_m))


def test_map_has_the_view_of_a_camera_and_the_calibrated_area() -> None:
    model = Model(0, "poly", (CameraModel("red", (), pairs=pairs_of_a_level_camera()),))
    scene = describe_floor(RIG, model, {"red": LENS})
    assert scene["bounds"] == [0.0, 0.0, 4.0, 3.0]
    (view,) = scene["views"]
    outline = np.array(view["outline"])
    # 999 and 599 px at a focal length of 500 px and a height of 2 m.
    reach_m = np.array([999, 599]) / 500
    assert outline.min(axis=0) == pytest.approx(np.array([2, 1.5]) - reach_m, abs=0.002)
    assert outline.max(axis=0) == pytest.approx(np.array([2, 1.5]) + reach_m, abs=0.002)
    assert {tuple(point) for point in scene["measured"]} == {(1.0, 1.0), (3.0, 1.0), (3.0, 2.0), (1.0, 2.0)}
    assert json.dumps(scene, allow_nan=False)


def test_map_without_a_floor_shows_all_that_is_known() -> None:
    model = Model(0, "poly", (CameraModel("red", (), pairs=pairs_of_a_level_camera()),))
    low_x, low_y, high_x, high_y = describe_floor(None, model, {})["bounds"]
    assert (low_x, low_y, high_x, high_y) == (0.5, 0.5, 3.5, 2.5)
    assert describe_floor(None, None, {})["bounds"][2] > 0


def parts(data: bytes) -> dict[str, Any]:
    events = [text.split("\n") for text in data.decode().split("\n\n") if text]
    return {name.removeprefix("event: "): json.loads(line.removeprefix("data: ")) for name, line in events}


def test_data_are_made_once_for_all_pages(lab: LiveLab, monkeypatch: pytest.MonkeyPatch) -> None:
    feed, made, dumps = Feed(lab.dashboard), list[str](), json.dumps

    def note(*values: Any, **options: Any) -> str:
        made.append(dumps(*values, **options))
        return made[-1]

    monkeypatch.setattr(json, "dumps", note)
    pages: list[dict[str, int]] = [{} for _ in range(10)]
    assert {*parts(feed.newest(pages[0], 0.0))} == {"robots", "tiles", "status"}
    for page in pages[1:]:
        feed.newest(page, 0.001)
    assert len(made) == 3
    lab.feed(tracks(BEGIN_NS, robot(0, 1.0, 1.0)))
    assert [feed.newest(page, 0.01) for page in pages] == [b""] * 10  # at most 30 updates per second
    updates = [feed.newest(page, 0.05) for page in pages]
    assert [{*parts(data)} for data in updates] == [{"robots"}] * 10
    assert len(made) == 4
    # Without news, only the status is made again, after a second.
    assert [{*parts(feed.newest(pages[0], 0.1 + n / 30))} for n in range(60)].count({"status"}) == 2


def test_late_wake_ups_do_not_reduce_the_rate(lab: LiveLab) -> None:
    now_s, late_s, updates = 1000.0, 0.008, 0

    async def sleep(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds + late_s
        lab.feed(tracks(BEGIN_NS + round(now_s * 1e9), robot(0, 1.0, 1.0)))

    async def read() -> None:
        nonlocal updates
        async for data in Feed(lab.dashboard).stream(lambda: now_s, sleep):
            updates += b"event: robots" in data

    begin_s = now_s
    asyncio.run(read())
    assert updates / (now_s - begin_s) == pytest.approx(30, abs=0.5)


def test_slow_page_gets_only_the_newest_data(lab: LiveLab) -> None:
    feed, sent = Feed(lab.dashboard), dict[str, int]()
    feed.newest(sent, 0.0)
    for n in range(1, 100):
        lab.feed(tracks(BEGIN_NS + n, robot(0, n / 100, 1.0)))
        feed.newest({}, n / 10)  # another page reads everything
    (row,) = parts(feed.newest(sent, 100.0))["robots"]["robots"]
    assert row["x"] == 0.99


def test_failed_display_is_not_shown_as_the_end(lab: LiveLab) -> None:
    def messages() -> Any:
        yield None
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        lab.dashboard.consume(messages())
    assert lab.dashboard.status()["end"] == "failed"


def test_end_of_the_recording_is_shown(lab: LiveLab) -> None:
    assert lab.dashboard.status()["end"] is None
    lab.end()
    assert lab.dashboard.status()["end"] == "ended"
