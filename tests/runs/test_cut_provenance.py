"""Provenance of parts of logs: their runs are neither out of date nor computed again because of the cut."""

import json
import shutil
from pathlib import Path

import pytest

from ipsys_log.engine.output import append_messages
from ipsys_log.engine.request import Request
from ipsys_log.engine.states import recorded_stages
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import Measurement, Message
from ipsys_log.messages.channels import CUTS, MARKERS
from ipsys_log.tools.cut import cut
from ipsys_log.tools.cut_selection import CutOptions
from ipsys_log.tools.soundness.check import check_logs
from ipsys_log.tools.verify import verify
from tests.conftest import Ipsys
from tests.shared_files import make_once

REQUEST = Request(corners="stock", models=("rigid",))


@pytest.fixture(scope="session")
def stock_log(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small simulated session with all stages, its markers by the method without memory."""

    def write(folder: Path) -> None:
        shutil.copy(lab_log, folder / "monday.mcap")
        replay([folder / "monday.mcap"], REQUEST, "fuse")

    return make_once(tmp_path_factory, "stock", write) / "monday.mcap"


@pytest.fixture(scope="session")
def stock_part(stock_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fifteen seconds of it, to be copied before they are changed."""

    def write(folder: Path) -> None:
        cut([stock_log], folder / "part.mcap", CutOptions(start="5", end="20"))

    return make_once(tmp_path_factory, "stock_part", write) / "part.mcap"


@pytest.fixture
def part(stock_part: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(stock_part, tmp_path / "part.mcap"))


def states(log: Path) -> dict[str, str]:
    with Session([log]) as session:
        return {recorded.run.stage: recorded.state for recorded in recorded_stages(session)}


def verified(log: Path) -> tuple[dict[str, bool], list[str]]:
    """Return by topic whether a channel is repeated, all without a difference; and the remarks."""
    remarks: list[str] = []
    comparisons = verify([log], None, lambda stage, done, total: None, remarks.append)
    assert [one for one in comparisons if not one.equal] == []
    return {one.topic: one.repeated for one in comparisons}, remarks


def test_runs_of_a_part_name_the_log_they_come_from(part: Path) -> None:
    assert set(states(part).values()) == {"copied from monday.mcap"}


def test_part_without_a_camera_is_sound(stock_log: Path, tmp_path: Path) -> None:
    """A check knows that the inputs of its runs were cut."""
    path = tmp_path / "red.mcap"
    cut([stock_log], path, CutOptions(cameras=["red"]))
    (result,) = check_logs([path])
    assert (result.state, [finding.text for finding in result.remarks]) == ("sound", [])


def test_replay_of_a_part_computes_nothing(ipsys: Ipsys, part: Path) -> None:
    before = part.read_bytes()
    done = ipsys("fuse", part, "--corners", "stock", "--model", "rigid", "--json")
    assert done.code == 0, done.err
    assert {(row["run"], row["new"]) for row in json.loads(done.out)["stages"]} == {
        ("stock", False),
        ("rigid", False),
    }
    assert "out of date" not in done.err
    assert part.read_bytes() == before


def test_verify_compares_copied_runs_by_their_hashes(part: Path) -> None:
    repeated, remarks = verified(part)
    assert not any(repeated.values())
    assert {"/cameras/red/image", "/runs/stock/cameras/red/markers", "/runs/rigid/tracks"} <= repeated.keys()
    names = [("stock", ("detect", "camera-frame")), ("rigid", ("fit", "evaluate", "locate", "fuse"))]
    assert remarks == [
        f"run {run}: {stage} was copied from monday.mcap; its hashes are compared"
        for run, stages in names
        for stage in stages
    ]


def test_verify_repeats_copied_runs_with_whole_inputs(stock_log: Path, tmp_path: Path) -> None:
    """Only the images are left out: markers cannot be repeated, all that follows from them can."""
    small = tmp_path / "small.mcap"
    cut([stock_log], small, CutOptions(exclude_topics=("/cameras/*/image",)))
    repeated, remarks = verified(small)
    assert not repeated["/runs/stock/cameras/red/markers"]
    assert repeated["/runs/stock/cameras/red/camera_points"]
    assert repeated["/runs/rigid/tracks"]
    assert remarks == ["run stock: detect was copied from monday.mcap; its hashes are compared"]
    assert {state for stage, state in states(small).items() if stage != "detect"} == {"current"}


@pytest.mark.parametrize(
    "options",
    [
        CutOptions(cameras=("red",)),
        CutOptions(every=2),
        CutOptions(robots=("robot_0",)),
        CutOptions(end="50"),
    ],
    ids=["camera", "every", "robot", "time"],
)
def test_cut_of_a_cut_keeps_the_chain(part: Path, options: CutOptions) -> None:
    small = part.with_name("small.mcap")
    cut([part], small, options)
    assert states(small)["detect"] == "copied from monday.mcap"
    with Session([small]) as session:
        assert [one.logs for one in session.payloads(session.topics(CUTS))] == [
            ("monday.mcap",),
            ("part.mcap",),
        ]
    repeated, _ = verified(small)
    assert "/runs/stock/cameras/red/camera_points" in repeated


def test_left_out_result_is_computed_under_another_name(part: Path) -> None:
    """The part has the record of run stock, and its markers are left out."""
    small = part.with_name("small.mcap")
    cut([part], small, CutOptions(topics=("/cameras/*",)))
    assert states(small)["detect"] == "copied from monday.mcap"
    outcomes = replay([small], REQUEST, "detect")
    assert [(one.run, one.fresh) for one in outcomes] == [("stock_2", True)]
    with Session([small]) as session:
        assert session.topics(MARKERS, "stock_2")
    repeated, _ = verified(small)
    assert repeated["/runs/stock_2/cameras/red/markers"]


@pytest.mark.parametrize("topic", ["/cameras/red/image", "/runs/rigid/tracks", "/truth/tracks"])
def test_changed_byte_in_a_part_is_found(ipsys: Ipsys, part: Path, topic: str) -> None:
    """The part is written again with one changed byte, its hashes and CRCs are right."""
    changed = part.with_name("changed.mcap")
    with Session([part]) as session, LogWriter.create(changed) as writer:
        reader = session.readers[0]
        tampered = False
        for message in reader.messages():
            channel = reader.channels[message.topic]
            writer.add_channel(message.topic, channel.schema, channel.message_encoding)
            data = bytes(message.data)
            if message.topic == topic and not tampered:
                data, tampered = data[:-1] + bytes([data[-1] ^ 1]), True
            writer.write(message.topic, message.log_time_ns, message.publish_time_ns, data)
    done = ipsys("verify", changed)
    assert done.code == 1
    assert topic.removeprefix("/runs/") in done.out + done.err


def test_byte_changed_in_place_is_found(part: Path) -> None:
    """The log keeps its old hashes: only the bytes tell that one of them has changed."""
    data = bytearray(part.read_bytes())
    with Session([part]) as session:
        image = next(session.readers[0].messages(["/cameras/red/image"])).data
    data[data.index(image) + len(image) // 2] ^= 1
    part.write_bytes(data)
    comparisons = verify([part], None, lambda stage, done, total: None)
    different = {one.topic for one in comparisons if not one.equal}
    assert "/cameras/red/image" in different
    assert all("/red/" in topic for topic in different)


def test_measurement_added_to_a_part_is_named(part: Path) -> None:
    """A change after the cut is no part of the cut."""
    with Session([part]) as session:
        time_ns = session.end_ns
    added = Measurement(time_ns, "later")
    append_messages(part, [Message("/measurements", time_ns, time_ns, added)])
    repeated, remarks = verified(part)
    assert "/measurements" not in repeated
    assert "/measurements: messages were added after the copy (1); it is not compared" in remarks
    found = states(part)
    assert found["fit"] == "out of date: measurements changed"
    assert found["detect"] == "copied from monday.mcap"


def test_unknown_run_of_a_part_is_refused(part: Path) -> None:
    with pytest.raises(IpsysError, match="has no run best"):
        verify([part], "best", lambda stage, done, total: None)
