"""The commands du and cat: all messages of a log as lines and as JSON, and their sizes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from ipsys_log.app.report.log_texts import message_json, message_line
from ipsys_log.engine.output import write_log
from ipsys_log.log.contents import RawMessage, Schema, StoredChannel
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import CameraPoint, CameraPoints, Message
from tests.conftest import ROOT, Ipsys

PAPER, SMALL = ROOT / "sample_logs/paper_lab.mcap", ROOT / "sample_logs/small_lab.mcap"


def stock_times(path: Path) -> list[tuple[str, int, int]]:
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.publish_time)
            for _, channel, message in make_reader(file).iter_messages()
        ]


def test_cat_prints_each_message_in_one_line_within_the_log_order(ipsys: Ipsys) -> None:
    done = ipsys("cat", SMALL, "--json")
    assert done.code == 0
    rows = [json.loads(line) for line in done.out.splitlines()]
    times = [(row["topic"], row["log_time_ns"], row["publish_time_ns"]) for row in rows]
    assert sorted(times) == sorted(stock_times(SMALL))
    assert [row["log_time_ns"] for row in rows] == sorted(row["log_time_ns"] for row in rows)
    image = next(row for row in rows if row["topic"] == "/cameras/red/image")
    assert image["data"]["data"].keys() == {"bytes"}
    assert image["schema"] == "foxglove.CompressedImage"
    shown = ipsys("cat", SMALL).out.splitlines()
    assert len(shown) == len(rows)
    line = next(line for line in shown if " /cameras/red/image " in line)
    assert f"data={image['data']['data']['bytes']} bytes" in line
    assert line.startswith("2023-11-14 22:13:2")


def test_cat_selects_topics_and_times(ipsys: Ipsys) -> None:
    stock = stock_times(PAPER)
    start_ns = min(time for _, time, _ in stock)
    done = ipsys("cat", PAPER, "--json", "--topics", "/measurements,/rig", "--end-offset", 30)
    wanted = [
        row for row in stock if row[0] in ("/measurements", "/rig") and row[1] < start_ns + 30_000_000_000
    ]
    assert 2 < len(wanted) == len(done.out.splitlines())
    secs = start_ns // 1_000_000_000 + 100
    later = ipsys("cat", PAPER, "--topics", "/measurements", "--start-secs", secs).out.splitlines()
    assert len(later) == sum(topic == "/measurements" and time >= secs * 10**9 for topic, time, _ in stock)
    done = ipsys("cat", PAPER, "--topics", "/nothing")
    assert done.code == 1
    assert "has no topic /nothing" in done.err


def test_cat_never_prints_nan_or_control_characters(ipsys: Ipsys, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    points = CameraPoints(7, (CameraPoint(1, float("nan"), 0.5, float("inf")),))
    topic = "/runs/a/cameras/red/camera_points"
    write_log(path, [Message(topic, 7, 7, points, "red")])
    with LogWriter.append(path) as log:
        for name, data in (("/\x1b[31m", b"\xff\x00"), ("/json", b'{"a": NaN, "b": "\\u001b[2J"}')):
            log.add_channel(name, Schema("Thing", "jsonschema", b"{}"), "json")
            log.write(name, 9, 9, data)
    lines = ipsys("cat", path, "--json").out.splitlines()
    assert "NaN" not in "".join(lines)
    assert "Infinity" not in "".join(lines)
    rows = {row["topic"]: row["data"] for row in map(json.loads, lines)}
    [point] = rows[topic]["points"]
    assert (point["x_m"], point["y_m"], point["z_m"]) == (None, 0.5, None)
    assert "heading_rad" not in point  # a missing field is absent
    assert rows["/\x1b[31m"] == {"bytes": 2}
    assert rows["/json"] == {"a": None, "b": "\x1b[2J"}
    shown = ipsys("cat", path).out
    assert "\x1b" not in shown
    assert "\\x1b[31m" in shown


def test_undecodable_message_is_one_line_with_its_size() -> None:
    channel = StoredChannel("/rig", Schema("ipsys.v1.Rig", "protobuf", b""), "protobuf", {}, 1)
    raw = RawMessage("/rig", 10**18, 10**18, b"\xff\xff")
    from ipsys_log.errors import LogError

    assert message_line(raw, LogError("bad"), channel).endswith("/rig [ipsys.v1.Rig] 2 bytes")
    assert json.loads(message_json(raw, LogError("bad"), channel))["error"] == "bad"


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_closed_pipe_ends_cat_quietly(options: list[str]) -> None:
    command = [sys.executable, "-m", "ipsys_log", "cat", str(PAPER), *options]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline()
        process.stdout.close()
        err = process.stderr.read()
    assert (process.returncode, err) == (0, b"")


def test_du_gives_sizes_and_shares_of_the_file(ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch) -> None:
    [result] = json.loads(ipsys("du", SMALL, "--json").out)["rows"]
    assert result["bytes"] == SMALL.stat().st_size
    stored = sum(row["stored_bytes"] for row in result["channels"])
    assert stored + result["other_bytes"] == result["bytes"]
    assert result["channels"][0]["topic"].endswith("/image")
    assert sum(row["messages"] for row in result["channels"]) == len(stock_times(SMALL))
    monkeypatch.setenv("COLUMNS", "80")
    shown = ipsys("du", SMALL, PAPER)
    assert shown.code == 0
    assert max(map(len, shown.out.splitlines())) <= 80
    assert "(definitions, indexes)" in shown.out
