"""The check of logs: sound logs of each kind, and a damaged or changed log for each finding."""

import json
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.reader import make_reader
from mcap.writer import Writer

import ipsys_log as ipsys
from ipsys_log.log.contents import Contents
from ipsys_log.log.journal import journal_path
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.summary import tail_bytes
from ipsys_log.messages import CameraCalibration, Distance, Event, Measurement, Message, Rig, RigCamera
from ipsys_log.tools.soundness.check import check_logs
from ipsys_log.tools.soundness.finding import LogCheck, LogFinding
from ipsys_log.tools.soundness.references import MessageTimes
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import scale_intrinsics
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys
from tests.log.conftest import Row, create
from tests.log.test_append_order import OLD, killed_at_each_operation

SAMPLES = [*(ROOT / "sample_logs").glob("*.mcap")]
RED = "/cameras/red/image"
Times = tuple[int, int, bytes]  # log time, publish time, data


def check(log: Path) -> LogCheck:
    [result] = check_logs([log])
    return result


def only(log: Path) -> LogFinding:
    """Return the only remark of a readable log."""
    result = check(log)
    assert result.state == "readable", result
    [finding] = result.remarks
    return finding


def fault(log: Path) -> str:
    result = check(log)
    assert result.state == "broken", result
    return next(finding.text for finding in result.findings if finding.level == "broken")


def stock_copy(
    log: Path,
    change: Callable[[str, Times], Times | None] = lambda topic, times: times,
    schema: Callable[[str, bytes], bytes] = lambda name, data: data,
) -> Path:
    """Copy a log with the mcap library, with changed messages and schemas."""
    path = log.with_name("copy.mcap")
    with log.open("rb") as source, path.open("wb") as target:
        writer = Writer(target)
        writer.start()
        channels: dict[str, int] = {}
        for definition, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                assert definition is not None
                data = schema(definition.name, definition.data)
                key = writer.register_schema(definition.name, definition.encoding, data)
                channels[channel.topic] = writer.register_channel(channel.topic, "protobuf", key)
            changed = change(channel.topic, (message.log_time, message.publish_time, message.data))
            if changed is not None:
                writer.add_message(channels[channel.topic], changed[0], changed[2], changed[1])
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def with_tail(log: Path, data: bytes, contents: Contents) -> Path:
    log.write_bytes(data + tail_bytes(contents))
    return log


def contents_of(log: Path) -> Contents:
    with LogReader(log) as reader:
        return reader._contents.copy()


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_sample_log_is_sound(path: Path) -> None:
    before = path.read_bytes()
    result = check(path)
    assert (result.state, result.remarks) == ("sound", ())
    assert any(finding.kind == "rate" for finding in result.findings) == (path.stem == "small_lab")
    assert path.read_bytes() == before


def test_session_and_live_recording_with_runs_are_sound(replayed_log: Path, recorded: Path) -> None:
    for path in (replayed_log, recorded):
        result = check(path)
        assert (result.state, result.remarks) == ("sound", ())
        runs = [finding.text for finding in result.findings if finding.kind == "run"]
        assert runs
        assert all(text.endswith(": current") or "not repeatable" in text for text in runs)


def test_derived_log_is_sound_with_the_log_of_its_inputs(lab_log: Path, calibration: Path) -> None:
    assert [result.state for result in ipsys.check(lab_log, calibration)] == ["sound", "sound"]
    alone = check(calibration)
    assert alone.state == "readable"
    assert "is not in the log" in " ".join(finding.text for finding in alone.remarks)


def test_damaged_chunk_is_named_until_the_log_is_repaired(lab: Path) -> None:
    data = bytearray(lab.read_bytes())
    data[len(data) // 2] ^= 1
    lab.write_bytes(data)
    assert "the CRC of the chunk is wrong" in fault(lab)
    assert check(lab).remarks[0].advice == f"run: ipsys repair {lab}"
    assert lab.read_bytes() == data
    repair(lab)
    assert check(lab).state != "broken"


def test_log_without_end_and_other_files_are_broken(lab: Path) -> None:
    lab.write_bytes(lab.read_bytes()[:-100])
    assert "has no end" in fault(lab)
    lab.write_bytes(b"P5 is no log")
    assert "is not an MCAP file" in fault(lab)
    lab.write_bytes(b"")
    assert "is empty" in fault(lab)


def test_wrong_statistics_are_found(lab: Path) -> None:
    contents = contents_of(lab)
    contents.count(1, 3)
    with_tail(lab, lab.read_bytes()[: contents.data_end], contents)
    total = sum(contents.counts.values())
    assert fault(lab) == f"readers count {total} messages, but there are {total - 3}"


def test_wrong_crcs_of_data_section_and_summary_are_found(lab: Path) -> None:
    whole, end = lab.read_bytes(), contents_of(lab).data_end
    lab.write_bytes(whole[: end + 9] + bytes([whole[end + 9] ^ 1]) + whole[end + 10 :])
    assert fault(lab).startswith("the CRC of the data section is wrong")
    lab.write_bytes(whole[: end + 40] + bytes([whole[end + 40] ^ 1]) + whole[end + 41 :])
    assert "the CRC of the summary is wrong" in fault(lab)


def test_message_changed_with_all_its_crcs_is_found_by_its_hash(lab: Path) -> None:
    contents, data = contents_of(lab), bytearray(lab.read_bytes())
    chunk = next(chunk for chunk in contents.chunks if not chunk.compression)
    start, end = chunk.offset + chunk.length - chunk.uncompressed_size, chunk.offset + chunk.length
    data[end - 1] ^= 1
    data[chunk.offset + 33 : chunk.offset + 37] = zlib.crc32(data[start:end]).to_bytes(4, "little")
    contents.data_crc = zlib.crc32(data[: contents.data_end])
    with_tail(lab, bytes(data[: contents.data_end]), contents)
    finding = only(lab)
    assert "do not match the hash" in finding.text
    assert str(finding.topic).endswith("/image")


def test_interrupted_append_is_a_remark_with_and_without_its_journal(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    path = create(tmp_path / "log" / "session.mcap", OLD)
    new: list[Row] = [("/points", NS_PER_S * k, k, bytes([k]) * 400) for k in range(20)]
    texts = set()
    for number, _ in enumerate(killed_at_each_operation(path, new)):
        if number % 2:
            journal_path(path).unlink(missing_ok=True)
        result = check(path)
        assert result.state != "broken", (number, result)
        texts |= {finding.text for finding in result.findings if finding.kind == "file"}
    assert texts == {"an append was interrupted: ipsys reads the log before it"}


def test_message_that_cannot_be_decoded_is_counted(lab: Path) -> None:
    seen: list[int] = []

    def change(topic: str, times: Times) -> Times:
        if topic == "/measurements":
            seen.append(times[0])
        return (*times[:2], b"\xff\xff") if topic == "/measurements" and len(seen) in (2, 3) else times

    result = check(stock_copy(lab, change))
    finding = next(finding for finding in result.remarks if finding.kind == "message")
    assert (finding.topic, finding.time_ns, finding.count) == ("/measurements", seen[1], 2)
    assert "not a valid ipsys.v1.Measurement" in finding.text


def test_schema_with_a_changed_field_is_found(lab: Path) -> None:
    def change(name: str, data: bytes) -> bytes:
        files = FileDescriptorSet.FromString(data)
        if name == "ipsys.v1.Measurement":
            message = next(m for file in files.file for m in file.message_type if m.name == "Measurement")
            message.field[1].name = "label"
        return files.SerializeToString()

    finding = only(stock_copy(lab, schema=change))
    assert (finding.kind, finding.topic) == ("schema", "/measurements")
    assert "(label) is another field here (id)" in finding.text


def test_schema_with_more_fields_and_unknown_channels_are_sound(lab: Path) -> None:
    def change(name: str, data: bytes) -> bytes:
        files = FileDescriptorSet.FromString(data)
        if name == "ipsys.v1.Rig":
            message = next(m for file in files.file for m in file.message_type if m.name == "Rig")
            kind = FieldDescriptorProto.TYPE_STRING
            message.field.add(name="colour", number=99, type=kind, label=FieldDescriptorProto.LABEL_OPTIONAL)
        return files.SerializeToString()

    path = stock_copy(lab, schema=change)
    result = check(path)
    assert result.state == "sound"
    assert any("newer software" in finding.text for finding in result.findings)


def test_log_times_that_decrease_and_stamps_that_repeat_are_found(lab: Path) -> None:
    last: dict[str, int] = {}

    def back(topic: str, times: Times) -> Times:
        last[topic] = last.get(topic, 0) + 1
        is_moved = topic == RED and last[topic] == 20  # in the drive, where frames are 0.2 s apart
        return (times[0] - NS_PER_S // 4, *times[1:]) if is_moved else times

    finding = only(stock_copy(lab, back))
    assert (finding.kind, finding.topic, finding.count) == ("time", RED, 1)
    assert finding.text == "log times decrease"

    first: list[int] = []

    def frozen(topic: str, times: Times) -> Times:
        if topic == RED:
            first.append(times[1])
            return times[0], first[0], times[2]
        return times

    result = only(stock_copy(lab, frozen))
    assert (result.text, result.topic, result.count) == ("capture times do not increase", RED, len(first) - 1)


def test_few_messages_far_from_all_others_are_found() -> None:
    times = MessageTimes({"/image"})
    start_ns = 1_700_000_000 * NS_PER_S
    for number in range(100):
        times.add("/image", start_ns + number, start_ns + number)
    times.add("/events", 5, 5)
    times.add("/image", start_ns + 101, 7)
    found = {finding.topic: finding for finding in times.findings()}
    assert found["/events"].time_ns == 5
    assert "far from those of the log (2023-11-14)" in found["/events"].text
    texts = [finding.text for finding in times.findings() if finding.topic == "/image"]
    assert texts == ["capture times do not increase", "capture times are more than a day from the log times"]


def test_gap_of_one_camera_is_found_and_a_pause_of_all_is_none(lab: Path) -> None:
    count: list[int] = []

    def without(message: Message) -> Message | None:
        if message.topic == RED:
            count.append(message.log_time_ns)
            return None if len(count) in (11, 12) else message
        return message

    finding = only(rewrite(lab, without))
    assert (finding.kind, finding.topic, finding.count) == ("rate", RED, 1)
    assert finding.time_ns == count[9]
    assert "one gap of 6." in finding.text
    pauses = [f for f in check(lab).findings if f.text.startswith("the recording pauses")]
    assert len(pauses) == 3


def test_events_of_the_recorder_are_counted(lab: Path) -> None:
    end_ns = 2_000_000_000 * NS_PER_S
    with LogReader(lab) as reader:
        end_ns = int(reader.end_ns or 0)
    events = [Event(end_ns, "frames_dropped", "3 frames of camera red dropped", "red") for _ in range(2)]
    extra = tuple(Message("/events", end_ns + n, end_ns + n, event) for n, event in enumerate(events, 1))
    finding = only(rewrite(lab, lambda message: message, extra))
    assert (finding.kind, finding.count) == ("event", 2)
    assert finding.text == "frames_dropped: 3 frames of camera red dropped"


def _without_rig(message: Message) -> Message | None:
    return None if isinstance(message.payload, Rig) else message


def _without_red(message: Message) -> Message:
    if isinstance(message.payload, Rig):
        rig = replace(message.payload, cameras=(RigCamera("white"), RigCamera("black")))
        return replace(message, payload=rig)
    return message


def _without_lens(message: Message) -> Message | None:
    is_red = isinstance(message.payload, CameraCalibration) and message.camera == "red"
    return None if is_red else message


def _other_size(message: Message) -> Message:
    if isinstance(message.payload, CameraCalibration) and message.camera == "red":
        return replace(message, payload=scale_intrinsics(message.payload, 1920, 1080, "red"))
    return message


def _measured(**changes: object) -> Callable[[Message], Message]:
    def change(message: Message) -> Message:
        payload = message.payload
        if isinstance(payload, Measurement) and payload.id == "s003":
            return replace(message, payload=replace(payload, **changes))  # type: ignore[arg-type]
        return message

    return change


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (_without_rig, "the log has no rig"),
        (_without_red, "camera red is not in the rig, which has black, white"),
        (_without_lens, "camera red has no intrinsics"),
        (_other_size, "are for 1920 x 1080 px, but its images have 960 x 540 px"),
        (_measured(marker_id=77), "measurement s003: marker 77 is not in the rig"),
        (_measured(distances=(Distance("Z", 1.0),)), "measurement s003: reference point Z is not in the rig"),
        (_measured(withdraws="p999"), "measurement s003: withdraws p999, which is not in the log"),
        (_measured(id="s002"), "measurement s002: an earlier measurement has the same id"),
    ],
)
def test_wrong_reference_is_found(lab: Path, change: Callable[[Message], Message | None], text: str) -> None:
    finding = only(rewrite(lab, change))
    assert finding.kind == "reference"
    assert text in finding.text
    assert finding.advice


def test_states_of_runs_are_those_of_the_list_of_runs(replayed_lab: Path, ipsys: Ipsys) -> None:
    def without_positions(topic: str, times: Times) -> Times | None:
        return None if topic == "/runs/poly/cameras/red/positions" else times

    assert [finding.text for finding in check(stock_copy(replayed_lab, without_positions)).remarks] == [
        "run poly, locate: unfinished",
        "run poly, fuse: its input /runs/poly/cameras/red/positions is not in the log",
    ]

    def other_lens(topic: str, times: Times) -> Times:
        return (times[0] - 1, *times[1:]) if topic == "/cameras/red/calibration" else times

    result = check(stock_copy(replayed_lab, other_lens))
    texts = [finding.text for finding in result.remarks]
    assert "run edges, detect: out of date: the lens of red changed" in texts
    listed = json.loads(ipsys("runs", replayed_lab.with_name("copy.mcap"), "--json").out)["rows"]
    assert {text.split(": ", 1)[1] for text in texts} <= {row["state"] for row in listed}

    def without_record(topic: str, times: Times) -> Times | None:
        return None if topic == "/runs/poly/record" else times

    texts = [finding.text for finding in check(stock_copy(replayed_lab, without_record)).remarks]
    assert texts == ["run poly has no record: its writer was stopped"]


def test_command_gives_the_answer_first_and_its_exit_code(lab: Path, ipsys: Ipsys) -> None:
    done = ipsys("check", lab)
    assert (done.code, done.out) == (0, f"{lab}: sound\n")
    remark = rewrite(lab, _without_lens)
    done = ipsys("check", lab, remark)
    assert done.code == 1
    first, second, third = done.out.splitlines()
    assert (first, second) == (f"{lab}: sound", f"{remark}: readable, 1 remark")
    assert third.startswith(f"  {RED}: camera red has no intrinsics; calibrate it")
    broken = lab.with_name("broken.mcap")
    broken.write_bytes(lab.read_bytes()[:-100])
    done = ipsys("check", broken, remark)
    assert done.code == 2
    assert done.out.startswith(f"{broken}: broken: has no end")
    assert "ipsys repair" in done.out


def test_api_gives_the_same_findings(lab: Path) -> None:
    changed = rewrite(lab, _without_lens)
    with ipsys.open(changed) as log:
        assert log.check() == ipsys.check(changed) == check_logs([changed])
