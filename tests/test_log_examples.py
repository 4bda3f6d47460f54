"""The programs for logs without ipsys: a reader and a writer."""

import ast
import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ipsys_log.log.dataset import Session
from tests.conftest import ROOT, Ipsys

_EXAMPLES = ROOT / "examples" / "log"
_GOLDEN = ROOT / "tests" / "golden" / "v0_1_0.mcap"


def test_reader_gives_the_tracks_of_the_log() -> None:
    read = runpy.run_path(str(_EXAMPLES / "read_log.py"))["read"]
    lines = list(read(_GOLDEN, ["/runs/poly/tracks"]))
    with Session([_GOLDEN]) as session:
        messages = list(session.messages(["/runs/poly/tracks"]))
    assert len(lines) == len(messages) > 10
    for (topic, *times_ns, fields), message in zip(lines, messages, strict=True):
        assert topic == message.topic
        assert times_ns == [message.log_time_ns, message.publish_time_ns]
        names = ("robot", "id", "x_m", "y_m", "z_m", "heading_rad")
        expected = [[getattr(track, name) for name in names] for track in message.payload.tracks]
        assert [[track.get(name) for name in names] for track in fields["tracks"]] == expected


def test_reader_prints_lines_of_json_for_every_topic() -> None:
    """Each schema of a log has all definitions that it needs."""
    command = [sys.executable, str(_EXAMPLES / "read_log.py"), str(_GOLDEN)]
    done = subprocess.run(
        [*command, "/rig", "/measurements", "/runs/poly/model"], capture_output=True, text=True, check=True
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert {row["topic"] for row in rows} == {"/rig", "/measurements", "/runs/poly/model"}
    assert rows[0]["dictionary"] == "DICT_4X4_100"


@pytest.mark.parametrize("name", ["read_log.py", "write_log.py"])
def test_examples_do_not_import_ipsys(name: str) -> None:
    source = (_EXAMPLES / name).read_text(encoding="utf-8")
    modules = [
        node.module or "" if isinstance(node, ast.ImportFrom) else node.names[0].name
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    assert modules
    assert not [module for module in modules if "ipsys" in module]
    assert len(source.splitlines()) < 50


def test_markers_in_a_log_of_the_writer_are_detected(tmp_path: Path, ipsys: Ipsys) -> None:
    write: Any = runpy.run_path(str(_EXAMPLES / "write_log.py"))["write"]
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    picture = np.full((360, 640), 220, np.uint8)
    picture[120:220, 200:300] = cv2.aruco.generateImageMarker(dictionary, 7, 100)
    image = cv2.imencode(".jpg", picture)[1].tobytes()
    rig, log = tmp_path / "lab.toml", tmp_path / "other.mcap"
    rig.write_text('name = "other"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n', encoding="utf-8")
    write(log, "red", 10, [image] * 3, 1_700_000_000_000_000_000)
    done = ipsys("detect", log, "--rig", rig, "--corners", "stock")
    assert done.code == 0, done.err
    read = runpy.run_path(str(_EXAMPLES / "read_log.py"))["read"]
    images = [fields["format"] for *_, fields in read(log, ["/cameras/red/image"])]
    assert images == ["jpeg"] * 3
    markers = [fields["markers"] for *_, fields in read(log, ["/runs/stock/cameras/red/markers"])]
    assert [[marker["id"] for marker in row] for row in markers] == [[7]] * 3
    assert markers[0][0]["corners_px"][:2] == pytest.approx([199.5, 119.5], abs=1.0)
