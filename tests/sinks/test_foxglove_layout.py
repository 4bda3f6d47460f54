"""The layout of Foxglove for a log: its topics, message paths, settings and user scripts."""

import json
import re
import runpy
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import foxglove.layouts as fl
import numpy as np
import pytest

from ipsys_log.capture.simulation.settings import grid_names
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import LATENCY_TOPIC, CompressedImage, Latency, Message, image_topic
from ipsys_log.sinks.foxglove_layout import _grid, make_layout
from tests.conftest import ROOT, Ipsys
from tests.sinks.streaming import write_tilted

_SCORED = ROOT / "tests" / "golden" / "v0_1_0.mcap"
_PATH = re.compile(r'(/[\w/]+?)(?:\.(\w+)\[:\])?\{(\w+)=="(\w+)"\}\.(\w+)')
# The types of user scripts; Foxglove compiles TypeScript, Node runs what remains.
_TYPES = re.compile(r"^type Output = .*$|: any\b|: Output( \| undefined)?(?= \{)", re.MULTILINE)
_DRIVER = """
import script, { inputs, output } from "./script.mjs";
const events = JSON.parse(await new Response(process.stdin).text());
console.log(JSON.stringify({ inputs, output, results: events.map(event => script(event) ?? null) }));
"""


@pytest.fixture(scope="module")
def layout(recorded: Path) -> dict[str, Any]:
    with Session([recorded]) as session:
        return make_layout(session)


@pytest.fixture(scope="module")
def scored_layout() -> dict[str, Any]:
    """The layout of a log with a ground truth, and without images."""
    with Session([_SCORED]) as session:
        return make_layout(session)


def panels(tree: Any) -> Iterator[str]:
    """Yield the panels of a layout."""
    if isinstance(tree, str):
        yield tree
    else:
        assert 0 < tree["splitPercentage"] < 100
        yield from (*panels(tree["first"]), *panels(tree["second"]))


def messages(log: Path, *topics: str) -> list[dict[str, Any]]:
    """Return messages as Foxglove gives them to a user script."""
    read = runpy.run_path(str(ROOT / "examples" / "log" / "read_log.py"))["read"]
    return [{"topic": topic, "message": stamped(fields)} for topic, _, _, fields in read(log, topics)]


def stamped(fields: Any) -> Any:
    """Replace the times of JSON by seconds and nanoseconds."""
    if isinstance(fields, dict):
        return {name: stamped(value) for name, value in fields.items()}
    if isinstance(fields, list):
        return [stamped(value) for value in fields]
    if isinstance(fields, str) and re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:.]+Z", fields):
        time_ns = int(np.datetime64(fields.removesuffix("Z"), "ns").astype(np.int64))
        return {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}
    return fields


def run_script(source: str, events: list[dict[str, Any]], folder: Path) -> dict[str, Any]:
    """Run a user script on messages; return its topics and results."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("no Node to run the user scripts with; on Debian: apt-get install nodejs")
    (folder / "script.mjs").write_text(_TYPES.sub("", source), encoding="utf-8")
    (folder / "driver.mjs").write_text(_DRIVER, encoding="utf-8")
    done = subprocess.run(
        [node, "driver.mjs"],
        cwd=folder,
        input=json.dumps(events),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def test_every_panel_is_shown_once(layout: dict[str, Any], scored_layout: dict[str, Any]) -> None:
    shown = list(panels(layout["layout"]))
    assert sorted(shown) == sorted(layout["configById"])
    images = [name for name in shown if name.startswith("Image!")]
    assert shown == [*images, "3D!floor", "Plot!position", "Plot!latency"]
    assert list(panels(scored_layout["layout"])) == ["3D!floor", "Plot!position", "Plot!error"]


def areas(tree: Any, width: float = 1.0, height: float = 1.0) -> Iterator[tuple[str, float, float]]:
    """Yield the panels of a layout with their shares of its width and height."""
    if isinstance(tree, str):
        yield tree, width, height
        return
    share = tree["splitPercentage"] / 100
    for part, own in (("first", share), ("second", 1 - share)):
        is_row = tree["direction"] == "row"
        yield from areas(tree[part], width * (own if is_row else 1), height * (1 if is_row else own))


def test_images_of_a_hall_are_a_grid_and_latencies_one_line(tmp_path: Path) -> None:
    log = tmp_path / "hall.mcap"
    write_log(log, hall_messages(grid_names(6, 4)))
    with Session([log]) as session:
        layout = make_layout(session)
    sizes = {name: (width, height) for name, width, height in areas(layout["layout"])}
    assert sorted(sizes) == sorted(layout["configById"])
    images = [size for name, size in sizes.items() if name.startswith("Image!")]
    assert len(images) == 24
    assert min(height for _, height in images) > 0.15
    assert min(width for width, _ in images) > 0.06
    (path,) = layout["configById"]["Plot!latency"]["paths"]
    assert path["label"] == "all cameras"


def hall_messages(names: Sequence[str]) -> Iterator[Message]:
    for number, name in enumerate(names, 1):
        frame = CompressedImage(number, name, b"\xff\xd8\xff", "jpeg")
        yield Message(image_topic(name), number, number, frame, name)
    latency = Latency(1, names[0], 1, 2, 3, 4, 5)
    yield Message(LATENCY_TOPIC, len(names) + 1, 1, latency)


def test_images_have_their_markers_and_calibration(layout: dict[str, Any], recorded: Path) -> None:
    with Session([recorded]) as session:
        cameras = sorted(session.images)
        for camera in cameras:
            mode = layout["configById"][f"Image!{camera}"]["imageMode"]
            (annotations,) = mode["annotations"]
            assert mode["imageTopic"] == f"/cameras/{camera}/image"
            for topic in (mode["imageTopic"], mode["calibrationTopic"], annotations):
                assert session.count(topic) > 0
                assert f"/{camera}/" in topic
        assert all(session.count(topic) for topic in layout["configById"]["3D!floor"]["topics"])
    assert len(cameras) > 0


def test_paths_of_plots_have_values_in_a_live_log(
    layout: dict[str, Any], recorded: Path, tmp_path: Path
) -> None:
    check_paths(layout, recorded, tmp_path)


def test_paths_of_plots_have_values_in_a_log_with_truth(
    scored_layout: dict[str, Any], tmp_path: Path
) -> None:
    check_paths(scored_layout, _SCORED, tmp_path)


def check_paths(layout: dict[str, Any], recorded: Path, tmp_path: Path) -> None:
    """Check that each message path of a plot gives numbers for the log."""
    scripts = {}
    for script in layout["userNodes"].values():
        inputs = json.loads(re.findall(r"inputs = (.*);", script["sourceCode"])[0])
        result = run_script(script["sourceCode"], messages(recorded, *inputs), tmp_path)
        scripts[result["output"]] = [one for one in result["results"] if one is not None]
    plots = [panel for name, panel in layout["configById"].items() if name.startswith("Plot")]
    paths = [path for panel in plots for path in panel["paths"]]
    assert len(paths) > 5
    assert all(path["enabled"] for path in paths)
    for path in paths:
        found = _PATH.fullmatch(path["value"])
        assert found is not None, path
        topic, rows, key, name, field = found.groups()
        shown = scripts.get(topic) or [event["message"] for event in messages(recorded, topic)]
        values = [row for one in shown for row in (one[rows] if rows else [one]) if row[key] == name]
        assert values, path["value"]
        assert all(np.isfinite(row[field]) for row in values)


def test_script_of_the_latency_equals_the_ledger(
    layout: dict[str, Any], recorded: Path, tmp_path: Path
) -> None:
    source = layout["userNodes"]["latency"]["sourceCode"]
    results = run_script(source, messages(recorded, "/latency"), tmp_path)["results"]
    with Session([recorded]) as session:
        ledger = session.payloads(["/latency"])
    assert [one["camera"] for one in results] == [one.camera for one in ledger]
    expected_ms = [(one.published - one.received) / 1e6 for one in ledger]
    np.testing.assert_allclose([one["latency_ms"] for one in results], expected_ms, atol=1e-6)


def test_script_of_the_error_compares_the_same_robot_and_instant(
    scored_layout: dict[str, Any], tmp_path: Path
) -> None:
    def event(topic: str, nsec: int, **robots: tuple[float, float]) -> dict[str, Any]:
        tracks = [{"robot": name, "x_m": x_m, "y_m": y_m} for name, (x_m, y_m) in robots.items()]
        return {"topic": topic, "message": {"timestamp": {"sec": 1, "nsec": nsec}, "tracks": tracks}}

    source = scored_layout["userNodes"]["position_error"]["sourceCode"]
    truth, tracks = json.loads(re.findall(r"inputs = (.*);", source)[0])
    events = [
        event(truth, 1, ada=(1.0, 2.0), bob=(0.0, 0.0)),
        event(tracks, 1, ada=(1.003, 2.004)),
        event(tracks, 2, ada=(5.0, 5.0)),  # the truth of this instant comes later
        event(tracks, 3, bob=(0.0, 0.0)),  # it has no truth
        event(truth, 2, ada=(5.0, 5.01)),
        event(tracks, 4, ada=(1.0, 1.0)),
        event(tracks, 4, ada=(2.0, 2.0)),  # a later pose of the same instant counts
        event(truth, 4, ada=(2.0, 2.001)),
    ]
    results = run_script(source, events, tmp_path)["results"]
    errors = [one and {row["robot"]: round(row["error_mm"], 9) for row in one["robots"]} for one in results]
    assert errors == [None, {"ada": 5.0}, None, None, {"ada": 10.0}, None, None, {"ada": 1.0}]


def keys_of(part: Any) -> set[str]:
    """Return the settings that foxglove-sdk knows for a part of a layout."""
    return set(part._to_dict())


def test_settings_are_those_of_foxglove_sdk(layout: dict[str, Any], scored_layout: dict[str, Any]) -> None:
    known = {"foxglovePanelTitle"}
    for name, panel in {**layout["configById"], **scored_layout["configById"]}.items():
        if name.startswith("Image!"):
            assert set(panel) <= keys_of(fl.ImageConfig()) | known
            assert set(panel["imageMode"]) <= keys_of(fl.ImageModeConfig())
        elif name.startswith("3D!"):
            assert set(panel) <= keys_of(fl.ThreeDeeConfig()) | known
            assert set(panel["cameraState"]) <= keys_of(fl.ThreeDeeCameraState())
            assert set(panel["scene"]["transforms"]) <= keys_of(fl.BaseRendererTransforms())
            assert set(panel["layers"]["grid"]) <= keys_of(fl.BaseRendererGridLayerSettings())
        else:
            assert set(panel) <= keys_of(fl.PlotConfig()) | known
            assert all(set(path) <= keys_of(fl.PlotSeries()) for path in panel["paths"])
    for script in {**layout["userNodes"], **scored_layout["userNodes"]}.values():
        assert set(script) == keys_of(fl.UserScript(name="", source_code=""))


def test_command_writes_the_layout_and_keeps_the_log(recorded: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    before = recorded.read_bytes()
    done = ipsys("view", recorded, "--foxglove-layout", tmp_path / "layout.json")
    assert (done.code, done.out) == (0, "")
    assert done.err.endswith("in Foxglove: Layouts, Import from file\n")
    assert set(json.loads((tmp_path / "layout.json").read_text())["configById"]) > {"3D!floor"}
    assert recorded.read_bytes() == before
    wrong = ipsys("view", recorded, "--foxglove-layout", tmp_path / "layout.txt")
    assert (wrong.code, "use layout.json" in wrong.err) == (1, True)
    unknown = ipsys("view", recorded, "--run", "nothing", "--foxglove-layout", tmp_path / "x.json")
    assert (unknown.code, "has no run 'nothing'" in unknown.err) == (1, True)
    assert not (tmp_path / "x.json").exists()


def tile_sizes(node: Any, width: float, height: float) -> list[tuple[float, float]]:
    """Return width and height of each panel of a layout, in px."""
    if isinstance(node, str):
        return [(width, height)]
    share = node["splitPercentage"] / 100
    across = node["direction"] == "row"
    first = (width * share, height) if across else (width, height * share)
    second = (width * (1 - share), height) if across else (width, height * (1 - share))
    return [*tile_sizes(node["first"], *first), *tile_sizes(node["second"], *second)]


@pytest.mark.parametrize(("count", "least_px"), [(3, 580), (7, 300), (24, 190)])
def test_images_of_many_cameras_are_as_large_as_possible(count: int, least_px: float) -> None:
    """The images are in two fifths of a screen of 1920 x 1080; a title has 30 px."""
    tiles = tile_sizes(_grid([f"Image!{n}" for n in range(count)]), 0.4 * 1920, 1080)
    assert len(tiles) == count
    assert min(min(width, (height - 30) * 16 / 9) for width, height in tiles) >= least_px - 1


def test_height_is_plotted_of_robots_that_are_not_level(tmp_path: Path) -> None:
    with Session([write_tilted(tmp_path / "a.mcap")]) as session:
        paths = make_layout(session, ["poly"])["configById"]["Plot!position"]["paths"]
    assert [path["label"] for path in paths] == ["ada x", "ada y", "ada z", "bob x", "bob y"]
