"""Provenance of merged logs: the runs of all recorders, and new results at the times of one clock."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.engine.states import recorded_stages
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.codec import decode, encode, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import shift_times
from ipsys_log.messages import Message
from ipsys_log.messages.channels import MODEL, TRACKS
from ipsys_log.tools.cut import cut
from ipsys_log.tools.cut_selection import CutOptions
from ipsys_log.tools.merge import merge
from ipsys_log.tools.merge_plan import LogOffset
from ipsys_log.tools.soundness.check import check_logs
from ipsys_log.tools.verify import verify
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


def states(log: Path) -> list[tuple[str, str, str]]:
    """Return run, stage and state of each recorded stage, sorted."""
    with Session([log]) as session:
        return sorted((one.run.run, one.run.stage, one.state) for one in recorded_stages(session))


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


COPIED = [("stock", stage, "copied from b.mcap") for stage in ("camera-frame", "detect")]


def test_runs_of_both_logs_keep_their_provenance(recorders_log: Recorders, merged_log: Path) -> None:
    """The run of the other cameras joins the run of the same name; its records are those of its log."""
    assert states(merged_log) == sorted([*states(recorders_log.first), *COPIED])
    with Session([recorders_log.second]) as session:
        before = {run.stage: run for run in session.runs()}
    with Session([merged_log]) as session:
        after = [run for run in session.runs() if any("white" in read.topic for read in run.inputs)]
    assert len(after) == len(before)
    for run in after:
        same = before[run.stage]
        assert (run.inputs, run.outputs, run.number) == (same.inputs, same.outputs, same.number)
    (result,) = check_logs([merged_log])
    assert (result.state, [finding.text for finding in result.remarks]) == ("sound", [])


def test_verify_of_a_merge_repeats_the_runs_with_whole_inputs(merged_log: Path) -> None:
    """The times of the second log have changed: its runs are compared by their hashes."""
    comparisons = {one.topic: one for one in verify([merged_log], None, lambda stage, done, total: None)}
    assert [one.topic for one in comparisons.values() if not one.equal] == []
    for camera, is_repeated in (("red", True), ("white", False)):
        for name in ("markers", "annotations", "camera_points"):
            assert comparisons[f"/runs/stock/cameras/{camera}/{name}"].repeated == is_repeated
    assert comparisons["/runs/rigid/tracks"].repeated
    assert not comparisons["/cameras/red/image"].repeated


def test_merge_of_parts_and_part_of_a_merge_keep_the_chain(recorders_log: Recorders, tmp_path: Path) -> None:
    part, output, small = (tmp_path / f"{name}.mcap" for name in ("part", "all", "small"))
    cut([recorders_log.second], part, CutOptions(end="20"))
    merge([recorders_log.first, part], output, [LogOffset(), LogOffset(OFFSET_NS)])
    assert states(output) == sorted([*states(recorders_log.first), *COPIED])
    cut([output], small, CutOptions(start="5", end="15"))
    assert {state for _, _, state in states(small)} == {"copied from a.mcap", "copied from b.mcap"}
    for log in (output, small):
        comparisons = verify([log], None, lambda stage, done, total: None)
        assert [one.topic for one in comparisons if not one.equal] == []


def test_merge_of_the_cameras_of_one_log_gives_its_runs(recorders_log: Recorders, tmp_path: Path) -> None:
    """Results that both parts have come once, and no run has changed."""
    whole, parts, output = (
        recorders_log.whole,
        [tmp_path / "a.mcap", tmp_path / "b.mcap"],
        tmp_path / "all.mcap",
    )
    cut([whole], parts[0], CutOptions(cameras=["red"]))
    cut([whole], parts[1], CutOptions(cameras=["white", "black"], exclude_topics=["/measurements"]))
    merge(parts, output, [LogOffset(), LogOffset()])
    assert states(output) == states(whole)
    comparisons = verify([output], None, lambda stage, done, total: None)
    assert all(one.equal for one in comparisons)
    assert {one.topic for one in comparisons if one.repeated} >= {"/runs/rigid/model", "/runs/rigid/tracks"}


def test_different_results_of_one_run_are_refused(recorders_log: Recorders, tmp_path: Path) -> None:
    """Each log has the model of another log, at its own time."""
    logs = [Path(shutil.copy(log, tmp_path)) for log in recorders_log[1:]]
    for log in logs:
        replay([log], replace(REQUEST, model_from=recorders_log.whole, run="live"), "locate")
    with pytest.raises(IpsysError, match=r"different results of run live: .*--exclude-runs live"):
        merge(logs, tmp_path / "all.mcap", [LogOffset(), LogOffset(OFFSET_NS)])
    assert sorted(tmp_path.iterdir()) == logs
