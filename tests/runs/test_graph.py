"""The graph of stages: a stage is one row, and channels with the same payload type are distinct."""

import json
import subprocess
import sys
from dataclasses import replace as with_changes
from pathlib import Path

import pytest

from ipsys_log.engine import graph
from ipsys_log.engine.graph import STAGES, stages_until
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import RawImage, Tracks, channels
from ipsys_log.messages.channels import (
    CHANNELS,
    IMAGES,
    RUN_EVENTS,
    SMOOTHED_TRACKS,
    TRACKS,
    TRUTH,
    channel_of,
)
from ipsys_log.stages import ENTRIES
from ipsys_log.tools.verify import verify
from tests.conftest import ROOT, Ipsys, data_section
from tests.runs import damping
from tests.runs.damping import DAMPED_TRACKS

POLY = Request(models=("poly",))


@pytest.fixture
def with_damping(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the stage damp to the graph: one more row and channel."""
    monkeypatch.setattr(channels, "CHANNELS", (*CHANNELS, DAMPED_TRACKS))
    monkeypatch.setattr(graph, "STAGES", (*STAGES, damping.STAGE))
    monkeypatch.setitem(graph.VERSIONS, "damp", 1)


@pytest.fixture
def log(detected_lab: Path) -> Path:
    """A log with its markers: the tests of later stages need not detect them again."""
    return detected_lab


@pytest.fixture
def whole(replayed_lab: Path) -> Path:
    """A log with all stages but the added one."""
    return replayed_lab


def names(until: str | None) -> list[str]:
    return [stage.name for stage in stages_until(until)]


def test_each_channel_has_one_writing_stage() -> None:
    written = [channel for stage in STAGES for channel in stage.writes if channel is not RUN_EVENTS]
    assert len(written) == len(set(written))
    without_stage = {channels.RECORD, channels.ESTIMATE, channels.CALIBRATED_RIG, RUN_EVENTS}
    derived = {channel for channel in CHANNELS if channel.is_derived} - without_stage
    assert set(written) == derived


def test_channel_names_and_topics_are_unique() -> None:
    assert (
        len({channel.name for channel in CHANNELS}) == len({one.topic for one in CHANNELS}) == len(CHANNELS)
    )


def test_stage_writes_a_payload_type_to_one_channel() -> None:
    for stage in STAGES:
        types = [payload for channel in stage.writes for payload in channel.payloads]
        assert len(types) == len(set(types))


@pytest.mark.parametrize(
    ("topic", "payload", "channel"),
    [
        ("/runs/poly/tracks", Tracks, TRACKS),
        ("/runs/poly/smoothed_tracks", Tracks, SMOOTHED_TRACKS),
        ("/runs/poly/damped_tracks", Tracks, None),
        ("/truth/tracks", Tracks, TRUTH),
        ("/robot/truth", Tracks, TRUTH),
        ("/front/image_raw", RawImage, IMAGES),
        ("/runs/poly/image", RawImage, None),
        ("no topic", RawImage, None),
        ("/rig", None, None),
    ],
)
def test_channel_is_identified_by_topic_and_payload(
    topic: str, payload: type | None, channel: channels.Channel | None
) -> None:
    assert channel_of(topic, payload) is channel


def test_stages_until_gives_the_needed_stages() -> None:
    assert names("detect") == ["detect"]
    assert names("locate") == ["detect", "camera-frame", "fit", "watch", "locate"]
    assert names("evaluate") == ["detect", "camera-frame", "fit", "evaluate"]
    # No other stage reads the results of fuse, and of evaluate, which comes before it.
    assert names("fuse") == names(None)
    # Smoothing runs on demand only, after all others.
    assert names("smooth") == [*names(None), "smooth"] == [stage.name for stage in STAGES]


def test_stage_of_one_row_and_one_channel_is_replayed(ipsys: Ipsys, whole: Path, with_damping: None) -> None:
    outcomes = replay([whole], POLY)
    assert [(one.stage, one.run) for one in outcomes[-2:]] == [("fuse", "poly"), ("damp", "poly")]
    with Session([whole]) as session:
        tracks = session.payloads(session.topics(TRACKS, "poly"))
        damped = session.payloads(session.topics(DAMPED_TRACKS, "poly"))
        assert session.topics(TRACKS, "poly") == ["/runs/poly/tracks"]
    assert len(tracks) == len(damped) > 0
    assert tracks[-1].tracks[0].x_m != damped[-1].tracks[0].x_m
    assert all(one.equal for one in verify([whole], None, lambda stage, done, total: None))
    rows = json.loads(ipsys("runs", whole, "--json").out)["rows"]
    assert {row["stage"]: row["state"] for row in rows}["damp"] == "current"


def test_stage_of_one_payload_type_is_done_once(whole: Path, with_damping: None) -> None:
    assert [one.stage for one in replay([whole], POLY) if one.fresh] == ["damp"]
    before = data_section(whole)
    assert not any(one.fresh for one in replay([whole], POLY))
    assert data_section(whole) == before


def test_parameter_of_an_added_stage_makes_another_run(whole: Path, with_damping: None) -> None:
    replay([whole], POLY)
    again = replay([whole], with_changes(POLY, parameters={"weight": "0.25"}))
    assert [(one.stage, one.run) for one in again if one.fresh] == [("damp", "poly_2")]


def test_row_of_an_added_stage_does_not_change_the_others(
    log: Path, replayed_log: Path, with_damping: None
) -> None:
    replay([log], POLY)
    with Session([log]) as ours, Session([replayed_log]) as theirs:
        topics = ["/runs/poly/tracks", "/runs/poly/poses", "/runs/edges/cameras/red/markers"]
        assert [ours.hash(topic) for topic in topics] == [theirs.hash(topic) for topic in topics]


def ipsys_with_damping(*arguments: object) -> str:
    """Run ``ipsys`` with the stage damp in its table; return its output."""
    command = [sys.executable, "-m", "tests.runs.damping", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=300)
    return done.stdout


def test_rows_have_the_names_of_their_entries() -> None:
    assert [stage.name for stage in STAGES] == [entry.name for entry in ENTRIES]


def test_added_stage_is_in_the_help_with_its_option() -> None:
    text = ipsys_with_damping("replay", "--help")
    assert "damp: Damp the tracks." in text
    assert "--weight" in text


@pytest.mark.slow
def test_added_stage_gets_its_parameters(whole: Path) -> None:
    results = [
        json.loads(ipsys_with_damping("replay", "--until", "damp", whole, "--json", *options))["stages"]
        for options in ((), ("--weight", "0.25"), ("--weight", "0.25"))
    ]
    assert [stages[-1]["stage"] for stages in results] == ["damp"] * 3
    assert [(stages[-1]["run"], stages[-1]["new"]) for stages in results] == [
        ("poly", True), ("poly_2", True), ("poly_2", False)
    ]  # fmt: skip


@pytest.mark.slow
def test_replay_command_runs_an_added_stage(log: Path) -> None:
    stages = json.loads(ipsys_with_damping("replay", log, "--json"))["stages"]
    assert [stage["stage"] for stage in stages] == [*names(None), "damp"]
