"""The graph of stages: a stage is one row, a channel is told from another one of the same payload type."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from ipsys_log.log.dataset import Session
from ipsys_log.messages import RawImage, Tracks, channels
from ipsys_log.messages.channels import CHANNELS, IMAGES, RUN_EVENTS, TRACKS, TRUTH, channel_of
from ipsys_log.pipeline import replay
from ipsys_log.runs import graph
from ipsys_log.runs.graph import STAGES, stages_until
from ipsys_log.runs.options import Request
from ipsys_log.runs.verify import verify
from tests.conftest import Ipsys, data_section
from tests.runs import smoothing
from tests.runs.smoothing import SMOOTHED_TRACKS


@pytest.fixture
def with_smoothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage smooth in the graph: one row more, and one channel."""
    monkeypatch.setattr(channels, "CHANNELS", (*CHANNELS, SMOOTHED_TRACKS))
    monkeypatch.setattr(graph, "STAGES", (*STAGES, smoothing.STAGE))
    monkeypatch.setitem(graph.VERSIONS, "smooth", 1)


@pytest.fixture
def log(detected_lab: Path) -> Path:
    """A log with its markers: the tests of later stages need not detect them again."""
    return detected_lab


def names(until: str | None) -> list[str]:
    return [stage.name for stage in stages_until(until)]


def test_each_channel_has_one_writing_stage() -> None:
    written = [channel for stage in STAGES for channel in stage.writes if channel is not RUN_EVENTS]
    assert len(written) == len(set(written))
    derived = {channel for channel in CHANNELS if channel.is_derived} - {channels.RECORD, RUN_EVENTS}
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
        ("/runs/poly/smoothed_tracks", Tracks, None),
        ("/truth/tracks", Tracks, TRUTH),
        ("/robot/truth", Tracks, TRUTH),
        ("/front/image_raw", RawImage, IMAGES),
        ("/runs/poly/image", RawImage, None),
        ("no topic", RawImage, None),
        ("/rig", None, None),
    ],
)
def test_channel_is_told_by_topic_and_payload(
    topic: str, payload: type | None, channel: channels.Channel | None
) -> None:
    assert channel_of(topic, payload) is channel


def test_stages_until_are_those_that_are_needed() -> None:
    assert names("detect") == ["detect"]
    assert names("locate") == ["detect", "camera-frame", "fit", "locate"]
    assert names("evaluate") == ["detect", "camera-frame", "fit", "evaluate"]
    # fuse is a result that no other stage reads; so is evaluate, which comes before it.
    assert names("fuse") == names(None) == [stage.name for stage in STAGES]


def test_stage_of_one_row_and_one_channel_is_replayed(ipsys: Ipsys, log: Path, with_smoothing: None) -> None:
    outcomes = replay([log], Request())
    assert [(one.stage, one.run) for one in outcomes[-2:]] == [("fuse", "poly"), ("smooth", "poly")]
    with Session([log]) as session:
        tracks = session.payloads(session.topics(TRACKS, "poly"))
        smoothed = session.payloads(session.topics(SMOOTHED_TRACKS, "poly"))
        assert session.topics(TRACKS, "poly") == ["/runs/poly/tracks"]
    assert len(tracks) == len(smoothed) > 0
    assert tracks[-1].tracks[0].x_m != smoothed[-1].tracks[0].x_m
    assert all(one.equal for one in verify([log], None, lambda stage, done, total: None))
    rows = json.loads(ipsys("runs", log, "--json").out)
    assert {row["stage"]: row["state"] for row in rows}["smooth"] == "current"


def test_stage_of_one_payload_type_is_done_once(log: Path, with_smoothing: None) -> None:
    replay([log], Request())
    before = data_section(log)
    assert not any(one.fresh for one in replay([log], Request()))
    assert data_section(log) == before


def test_parameter_of_an_added_stage_makes_another_run(log: Path, with_smoothing: None) -> None:
    replay([log], Request())
    again = replay([log], Request(parameters={"weight": "0.25"}))
    assert [(one.stage, one.run) for one in again if one.fresh] == [("smooth", "poly_2")]


def test_row_of_an_added_stage_does_not_change_the_others(
    log: Path, detected_log: Path, tmp_path: Path, with_smoothing: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay([log], Request())
    monkeypatch.undo()
    plain = Path(shutil.copy(detected_log, tmp_path / "plain.mcap"))
    replay([plain], Request())
    with Session([log]) as ours, Session([plain]) as theirs:
        topics = ["/runs/poly/tracks", "/runs/poly/poses", "/runs/edges/cameras/red/markers"]
        assert [ours.hash(topic) for topic in topics] == [theirs.hash(topic) for topic in topics]
