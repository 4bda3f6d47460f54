"""Provenance of merged logs: the runs of all recorders, and new results at the times of one clock."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ipsys_log.log.codec import decode, encode, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.log.shifted_times import shift_times
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import Message, Run
from ipsys_log.messages.channels import MODEL, TRACKS
from ipsys_log.pipeline import replay
from ipsys_log.runs.cut import cut
from ipsys_log.runs.cut_selection import CutOptions
from ipsys_log.runs.merge import merge
from ipsys_log.runs.merge_plan import LogOffset
from ipsys_log.runs.options import Request
from ipsys_log.runs.output import write_log
from ipsys_log.runs.states import recorded_stages
from ipsys_log.runs.verify import verify
from ipsys_log.soundness.check import check_logs
from tests.conftest import Ipsys
from tests.shared_files import make_once

pytestmark = pytest.mark.slow  # three logs with all stages

REQUEST = Request(corners="stock", models=("rigid",))
OFFSET_NS = 12_345_678


class Recorders(NamedTuple):
    """The simulated session as one log, and as the logs of two recorders; the clock of the second is late."""

    whole: Path
    first: Path
    second: Path


@pytest.fixture(scope="session")
def recorders_log(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Recorders:
    def write(folder: Path) -> None:
        whole, first, second = (folder / name for name in ("whole.mcap", "a.mcap", "b.mcap"))
        with Session([lab_log]) as session:
            messages = list(session.messages([t for reader in session.readers for t in reader.channels]))
        write_log(whole, messages)
        write_log(first, (m for m in messages if m.camera in (None, "red")))
        settings = (m for m in messages if m.topic == "/rig" or m.camera not in (None, "red"))
        write_log(second, _with_other_clock(settings))
        replay([whole], REQUEST, "fuse")
        replay([first], REQUEST, "fuse")
        replay([second], REQUEST, "camera-frame")

    folder = make_once(tmp_path_factory, "recorders", write)
    return Recorders(*(folder / name for name in ("whole.mcap", "a.mcap", "b.mcap")))


def _with_other_clock(messages: Iterator[Message]) -> Iterator[Message]:
    for message in messages:
        name = schema_name(type(message.payload))
        yield replace(
            message,
            log_time_ns=message.log_time_ns - OFFSET_NS,
            publish_time_ns=message.publish_time_ns - OFFSET_NS,
            payload=decode(name, shift_times(name, encode(message.payload), -OFFSET_NS)),
        )


@pytest.fixture(scope="session")
def merged_log(recorders_log: Recorders, tmp_path_factory: pytest.TempPathFactory) -> Path:
    def write(folder: Path) -> None:
        merge(recorders_log[1:], folder / "all.mcap", [LogOffset(), LogOffset(OFFSET_NS)])

    return make_once(tmp_path_factory, "merged", write) / "all.mcap"


@pytest.fixture
def merged_lab(merged_log: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(merged_log, tmp_path / "all.mcap"))


def states(log: Path) -> dict[tuple[str, str], str]:
    with Session([log]) as session:
        return {(one.run.run, one.run.stage): one.state for one in recorded_stages(session)}


def stored(log: Path, channel: Any, run: str) -> list[tuple[int, bytes]]:
    with Session([log]) as session:
        return [(m.log_time_ns, data) for m, data in session.stored(session.topics(channel, run))]


def test_replay_of_a_merge_equals_that_of_one_recorder(recorders_log: Recorders, merged_lab: Path) -> None:
    """With the right offset, all times are those of one clock: model and tracks have the same bytes."""
    outcomes = replay([merged_lab], REQUEST, "fuse")
    names = {one.stage: one.run for one in outcomes}
    assert all(one.fresh for one in outcomes)
    assert stored(merged_lab, MODEL, names["fit"]) == stored(recorders_log.whole, MODEL, "rigid")
    tracks = stored(merged_lab, TRACKS, names["fuse"])
    assert tracks == stored(recorders_log.whole, TRACKS, "rigid")
    assert tracks


def test_runs_of_both_logs_keep_their_provenance(recorders_log: Recorders, merged_log: Path) -> None:
    found = states(merged_log)
    assert {key: found[key] for key in states(recorders_log.first)} == states(recorders_log.first)
    assert found["stock_2", "detect"] == "run stock_2 merged from b.mcap"
    assert found["stock_2", "camera-frame"] == "run stock_2 merged from b.mcap"
    with Session([recorders_log.second]) as session:
        before = {run.stage: run for run in session.runs()}
    with Session([merged_log]) as session:
        after = {run.stage: run for run in session.runs() if run.run == "stock_2"}
    for stage, run in after.items():
        # The hashes are those of the channels that the stage has read: only names are new.
        assert [read.hash for read in run.inputs] == [read.hash for read in before[stage].inputs]
        assert (run.parameters, run.number) == (before[stage].parameters, before[stage].number)
    (result,) = check_logs([merged_log])
    assert (result.state, [finding.text for finding in result.remarks]) == ("sound", [])


def test_verify_of_a_merge_repeats_the_runs_of_both(merged_log: Path) -> None:
    comparisons = {one.topic: one for one in verify([merged_log], None, lambda stage, done, total: None)}
    assert [one.topic for one in comparisons.values() if not one.equal] == []
    with Session([merged_log]) as session:
        runs = {topic for topic in session.readers[0].channels if topic.startswith("/runs/")}
    results = {topic for topic in runs if not topic.endswith(("/record", "/events"))}
    assert {topic for topic, one in comparisons.items() if one.repeated} >= results
    assert "/cameras/red/image" in comparisons


@pytest.mark.parametrize("topic", ["/cameras/white/image", "/runs/stock_2/cameras/white/markers"])
def test_changed_byte_in_a_merge_is_found(ipsys: Ipsys, merged_log: Path, tmp_path: Path, topic: str) -> None:
    """The log is written again with one changed byte, its hashes and CRCs are right."""
    changed = tmp_path / "changed.mcap"
    with Session([merged_log]) as session, LogWriter.create(changed) as writer:
        (reader,) = session.readers
        is_changed = False
        for raw in reader.messages():
            channel = reader.channels[raw.topic]
            writer.add_channel(raw.topic, channel.schema, channel.message_encoding, channel.metadata)
            data = bytes(raw.data)
            if raw.topic == topic and not is_changed and len(data) > 50:
                data, is_changed = data[:-9] + bytes([data[-9] ^ 1]) + data[-8:], True
            writer.write(raw.topic, raw.log_time_ns, raw.publish_time_ns, data)
    assert is_changed
    done = ipsys("verify", changed)
    assert done.code == 1, done.out + done.err


def test_more_measurements_make_a_model_out_of_date(recorders_log: Recorders, tmp_path: Path) -> None:
    """A channel with messages of both logs is not the channel that the stage has read."""
    second, output = tmp_path / "b.mcap", tmp_path / "all.mcap"
    with Session([recorders_log.second]) as session, Session([recorders_log.first]) as other:
        messages = list(session.messages(["/rig", *session.images.values(), *session.calibrations.values()]))
        point = next(other.messages(["/measurements"]))
    write_log(second, [*messages, replace(point, payload=replace(point.payload, id="p999"))])
    merge([recorders_log.first, second], output, [LogOffset(), LogOffset()])
    found = states(output)
    assert found["rigid", "fit"] == "out of date: measurements changed"
    assert found["stock", "detect"] == "current"


def test_merge_of_parts_and_part_of_a_merge_keep_the_chain(recorders_log: Recorders, tmp_path: Path) -> None:
    part, output, small = (tmp_path / f"{name}.mcap" for name in ("part", "all", "small"))
    cut([recorders_log.second], part, CutOptions(end="20"))
    merge([recorders_log.first, part], output, [LogOffset(), LogOffset(OFFSET_NS)])
    assert states(output)["stock_2", "detect"] == "part of run stock_2, cut from b.mcap"
    assert all(one.equal for one in verify([output], "stock_2", lambda stage, done, total: None))
    cut([output], small, CutOptions(start="5", end="15"))
    assert states(small)["stock_2", "detect"].startswith("part of run stock_2, cut from ")
    comparisons = verify([small], None, lambda stage, done, total: None)
    assert [one.topic for one in comparisons if not one.equal] == []


def test_renamed_record_keeps_the_name_of_a_copied_model(recorders_log: Recorders, tmp_path: Path) -> None:
    """The model of another log has its own name there, also if a run of this log has the same name."""
    output = tmp_path / "all.mcap"
    second = Path(shutil.copy(recorders_log.second, tmp_path / "b.mcap"))
    request = replace(REQUEST, model_from=recorders_log.whole)
    replay([second], request, "locate")
    merge([recorders_log.first, second], output, [LogOffset(), LogOffset(OFFSET_NS)])
    with Session([output]) as session:
        runs = [run for run in session.runs() if run.run == "rigid_2"]
    copied = next(run for run in runs if isinstance(run, Run) and run.stage == "fit")
    assert [read.topic for read in copied.inputs] == ["/runs/rigid/model"]
    locate = next(run for run in runs if run.stage == "locate")
    assert "/runs/rigid_2/model" in [read.topic for read in locate.inputs]
    assert states(output)["rigid_2", "locate"] == "run rigid_2 merged from b.mcap"
