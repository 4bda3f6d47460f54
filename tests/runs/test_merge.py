"""Merges of logs: the messages of all logs at the times of the first clock."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from ipsys_log.engine.output import write_log
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import shift_times
from ipsys_log.messages import (
    CameraCalibration,
    CompressedImage,
    Event,
    Interval,
    Measurement,
    Message,
    Rig,
    RigCamera,
    RigMarker,
)
from ipsys_log.tools.merge import merge
from ipsys_log.tools.merge_plan import LogOffset
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys

START_NS = 1_700_000_000 * NS_PER_S
RIG = Rig("lab", "DICT_4X4_50", 0.1, (RigMarker(1, robot="a"),), (RigCamera("red"), RigCamera("white")))


class Row(NamedTuple):
    log_time_ns: int
    topic: str
    publish_time_ns: int
    data: bytes


def stock_rows(path: Path) -> list[Row]:
    """Return all messages but the records of merges, read by the ``mcap`` package, sorted."""
    with path.open("rb") as file:
        rows = [
            Row(message.log_time, channel.topic, message.publish_time, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]
    assert [row.log_time_ns for row in rows] == sorted(row.log_time_ns for row in rows)
    return sorted(row for row in rows if row.topic != "/merges")


def shifted(payload: Any, offset_ns: int) -> Any:
    """Return a payload of this module with all times shifted: the other road."""
    changes: dict[str, Any] = {"timestamp": payload.timestamp + offset_ns}
    if isinstance(payload, Measurement) and payload.still is not None:
        changes["still"] = Interval(payload.still.start + offset_ns, payload.still.end + offset_ns)
    if isinstance(payload, Event) and payload.start is not None:
        changes["start"] = payload.start + offset_ns
    return replace(payload, **changes)


def camera_messages(camera: str, times_ns: Sequence[int], rig: Rig | None = RIG) -> Iterator[Message]:
    """Yield the recording of one camera, with an event after each image."""
    if rig is not None:
        yield Message("/rig", times_ns[0] - 2, times_ns[0] - 2, rig)
    for number, time_ns in enumerate(times_ns):
        image = CompressedImage(time_ns - 5, camera, bytes([number % 256]) * 50_000, "jpeg")
        yield Message(f"/cameras/{camera}/image", time_ns, time_ns - 5, image, camera)
        event = Event(time_ns, "gap", f"{camera} {number}", camera, start=time_ns - 1)
        yield Message("/events", time_ns + 1, time_ns, event)


def write_recording(path: Path, camera: str, times_ns: Sequence[int], rig: Rig | None = RIG) -> list[Message]:
    messages = list(camera_messages(camera, times_ns, rig))
    write_log(path, messages)
    return messages


def expected_rows(logs: Sequence[tuple[Sequence[Message], int]]) -> list[Row]:
    """Return the rows of the merged log; the rig comes with the first log only."""
    rows = []
    for number, (messages, offset_ns) in enumerate(logs):
        for message in messages:
            if message.topic == "/rig" and number:
                continue
            payload = message.payload
            data = encode(payload if message.topic == "/rig" else shifted(payload, offset_ns))
            times = (message.log_time_ns + offset_ns, message.publish_time_ns + offset_ns)
            rows.append(Row(times[0], message.topic, times[1], data))
    return sorted(rows)


@settings(max_examples=40)
@given(
    starts_ms=st.lists(st.integers(0, 9_000), min_size=2, max_size=3),
    offsets_ns=st.lists(st.integers(-(10**10), 10**10) | st.just(0), min_size=3, max_size=3),
    frames=st.integers(1, 25),
)
def test_merged_log_is_the_shifted_union(
    tmp_path_factory: pytest.TempPathFactory, starts_ms: list[int], offsets_ns: list[int], frames: int
) -> None:
    """Recordings overlap, follow one another, or have a pause between them."""
    folder = tmp_path_factory.mktemp("merge")
    paths, logs = [], []
    offsets_ns[0] = 0
    for number, start_ms in enumerate(starts_ms):
        times_ns = [START_NS + start_ms * 1_000_000 + frame * 100_000_000 for frame in range(frames)]
        paths.append(folder / f"{number}.mcap")
        logs.append((write_recording(paths[-1], f"camera_{number}", times_ns), offsets_ns[number]))
    output = folder / "all.mcap"
    offsets = [LogOffset(offset_ns) for offset_ns in offsets_ns[: len(paths)]]
    result = merge(paths, output, offsets)
    rows = expected_rows(logs)
    assert stock_rows(output) == rows
    assert result.messages == len(rows)
    # The stored hashes are those of the messages.
    with Session([output]) as session:
        for one in {one.topic: one for log in result.logs for one in log.channels}.values():
            assert (one.kept, one.kept_hash) == (session.count(one.topic), session.hash(one.topic))
    for path in folder.iterdir():
        path.unlink()


def test_shift_back_gives_the_bytes_of_the_log(tmp_path: Path) -> None:
    """The channels of a later log have its name and its offset in their metadata."""
    a, b, output = (tmp_path / f"{name}.mcap" for name in ("a", "b", "all"))
    times_ns = [START_NS + frame * 100_000_000 for frame in range(30)]
    write_recording(a, "red", times_ns)
    write_recording(b, "white", [time_ns - 3_000_000_123 for time_ns in times_ns])
    merge([a, b], output, [LogOffset(), LogOffset(3_000_000_456)])
    undone = []
    with output.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.metadata.get("merged_from") == "b.mcap":
                assert schema is not None
                offset_ns = -int(channel.metadata["offset_ns"])
                data = shift_times(schema.name, message.data, offset_ns)
                times = message.log_time + offset_ns, message.publish_time + offset_ns
                undone.append(Row(times[0], channel.topic, times[1], data))
    assert sorted(undone) == [row for row in stock_rows(b) if row.topic != "/rig"]
    with Session([output]) as session:
        (record,) = session.payloads(["/merges"])
    assert [(log.name, log.offset_ns, log.offset_sigma_s) for log in record.logs] == [
        ("a.mcap", 0, None),
        ("b.mcap", 3_000_000_456, None),
    ]


def test_attachments_and_metadata_of_all_logs_survive(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.mcap" for name in ("a", "b")]
    for number, path in enumerate(paths):
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=200)
            writer.start("other", "test")
            schema = writer.register_schema("S", "jsonschema", b"{}")
            channel = writer.register_channel(f"/topic_{number}", "json", schema)
            writer.add_attachment(1, 2, f"{path.stem}.txt", "text/plain", path.stem.encode() * 100)
            writer.add_metadata(path.stem, {"room": str(number)})
            for count in range(20):
                writer.add_message(channel, 1_000 + count, b"{}", 1_000)
            writer.finish()  # type: ignore[no-untyped-call, unused-ignore]
    output = tmp_path / "all.mcap"
    merge(paths, output, [LogOffset(), LogOffset(7)])
    with output.open("rb") as file:
        reader = make_reader(file)
        attached = [(one.name, one.data) for one in reader.iter_attachments()]
        rooms = [(one.name, one.metadata) for one in reader.iter_metadata() if one.name in "ab"]
    assert attached == [("a.txt", b"a" * 100), ("b.txt", b"b" * 100)]
    assert rooms == [("a", {"room": "0"}), ("b", {"room": "1"})]
    # A schema that is not known here keeps its messages; their log times are shifted.
    times_ns = {row.topic: row.log_time_ns for row in reversed(stock_rows(output))}
    assert times_ns == {"/topic_0": 1_000, "/topic_1": 1_007}


def lens(camera: str, time_ns: int, focal_px: float = 400.0) -> Message:
    k = np.array([[focal_px, 0.0, 320.0], [0.0, focal_px, 240.0], [0.0, 0.0, 1.0]])
    payload = CameraCalibration(time_ns, camera, 640, 480, "plumb_bob", np.zeros(5), k)
    return Message(f"/cameras/{camera}/calibration", time_ns, time_ns, payload, camera)


TIMES_NS = [START_NS + frame * 100_000_000 for frame in range(5)]


def point(name: str) -> Message:
    return Message("/measurements", TIMES_NS[-1], TIMES_NS[-1], Measurement(TIMES_NS[-1], name, marker_id=1))


OTHER_LENGTH = replace(RIG, markers=(RigMarker(1, robot="a", length_m=0.12),))


@pytest.mark.parametrize(
    ("camera", "rig", "more", "text"),
    [
        ("red", RIG, (), "two cameras have the same name: red is in"),
        ("white", OTHER_LENGTH, (), None),
        (
            "white",
            replace(RIG, marker_length_m=0.2),
            (),
            "contradict each other: marker_length_m of the rig is 0.1 and 0.2",
        ),
        (
            "white",
            replace(RIG, markers=(RigMarker(1, robot="b"),)),
            (),
            "contradict each other: robot of marker 1 is 'a' and 'b'",
        ),
        ("white", RIG, (point("p001"),), "has a measurement with the id p001, too"),
        (
            "white",
            RIG,
            (lens("red", TIMES_NS[0], 401.0),),
            "contradict each other: the intrinsics of camera red differ",
        ),
        ("white", RIG, (lens("red", TIMES_NS[0] + 7),), None),
    ],
    ids=["camera", "added_length", "scalar", "marker", "measurement", "intrinsics", "equal_intrinsics"],
)
def test_contradiction_of_settings_is_one_line(
    ipsys: Ipsys, tmp_path: Path, camera: str, rig: Rig, more: tuple[Message, ...], text: str | None
) -> None:
    a, b, output = (tmp_path / f"{name}.mcap" for name in ("a", "b", "all"))
    write_log(a, [*camera_messages("red", TIMES_NS), lens("red", TIMES_NS[0]), point("p001")])
    write_log(b, [*camera_messages(camera, TIMES_NS, rig), *more])
    done = ipsys("merge", a, b, "-o", output, "--offset", "b=-0.012")
    if text is None:
        assert done.code == 0, done.err
        return
    assert (done.code, done.out) == (1, "")
    assert text in done.err.replace("\n", " ")
    assert sorted(tmp_path.iterdir()) == [a, b]


def test_rigs_with_different_cameras_become_one_rig(tmp_path: Path) -> None:
    a, b, output = (tmp_path / f"{name}.mcap" for name in ("a", "b", "all"))
    write_recording(a, "red", TIMES_NS, replace(RIG, cameras=(RigCamera("red", source="usb:1"),)))
    white = RigCamera("white", source="usb:1", row_time_ns=9)
    write_recording(b, "white", TIMES_NS, replace(RIG, cameras=(white,)))
    merge([a, b], output, [LogOffset(), LogOffset()])
    with Session([output]) as session:
        (rig,) = session.payloads(["/rig"])
    assert rig == replace(RIG, cameras=(RigCamera("red", source="usb:1"), white))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("a.mcap", "b.mcap", "--offset", "c=1"), "--offset c=1: does not name one log"),
        (("a.mcap", "b.mcap", "--offset", "a=1"), "the clock of the first log counts"),
        (("a.mcap", "b.mcap", "--offset", "b=soon"), "has no valid number of seconds"),
        (("a.mcap", "b.mcap", "--offset", "b=1", "--offset", "b.mcap=1"), "has two offsets"),
        (("a.mcap", "b.mcap", "--offset", "b=-1800000000"), "has no valid number of seconds"),
        (("a.mcap", "--offset", "b=1"), "does not name one log"),
        (("a.mcap",), "a merge needs two logs or more"),
        (("a.mcap", "a.mcap", "--offset", "a=1"), "does not name one log"),
    ],
)
def test_wrong_arguments_are_refused_with_one_line(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, camera in (("a", "red"), ("b", "white")):
        write_recording(Path(f"{name}.mcap"), camera, TIMES_NS)
    done = ipsys("merge", *arguments, "-o", "all.mcap")
    assert (done.code, done.out) == (1, "")
    assert text in done.err.replace("\n", " ")
    assert not list(tmp_path.glob("all*"))
