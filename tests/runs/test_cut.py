"""Cuts of logs: the messages of a part are those of the whole that the options select."""

import io
import itertools
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from ipsys_log.engine.output import write_log
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import Schema
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import (
    CameraPoint,
    CameraPoints,
    ChannelWritten,
    CompressedImage,
    CompressedVideo,
    Event,
    Measurement,
    Message,
    Rig,
    RigMarker,
    Run,
    Track,
    Tracks,
)
from ipsys_log.tools.cut import cut
from ipsys_log.tools.cut_selection import CutOptions
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys

START_NS = 1_700_000_000 * NS_PER_S
CAMERAS = ("red", "white")
FRAMES = 40
FRAME_NS = 100_000_000
LASTING = ("/rig", "/measurements", "/runs/stock/record", "/runs/rigid/record")


class Row(NamedTuple):
    topic: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


def lab_messages(picture: Callable[[int, str], object] | None = None) -> Iterator[Message]:
    """Yield the messages of a lab with two cameras, a run of camera points and a run of tracks."""
    rig = Rig("lab", "DICT_4X4_50", 0.1, (RigMarker(1, robot="a"), RigMarker(2, robot="b")))
    yield Message("/rig", START_NS, START_NS, rig)
    for number in range(FRAMES):
        time_ns = START_NS + (number + 1) * FRAME_NS
        for place, camera in enumerate(CAMERAS):
            at_ns = time_ns + place
            image = (
                picture(number, camera) if picture else CompressedImage(at_ns, camera, bytes(90_000), "jpeg")
            )
            yield Message(f"/cameras/{camera}/image", at_ns, at_ns - 5, image, camera)
            seen = (CameraPoint(1 + (number + place) % 3, 0.1, 0.2, 2.0 + number),)
            points = CameraPoints(at_ns, seen)
            yield Message(f"/runs/stock/cameras/{camera}/camera_points", at_ns, at_ns, points, camera)
            tracks = Tracks(at_ns, (Track("a", 1, 0.1, 0.2, 0.3),))
            yield Message("/runs/rigid/tracks", at_ns, at_ns, tracks)
        yield Message("/events", time_ns + 7, time_ns, Event(time_ns, "gap", f"gap {number}"))
    for name, stage, reads in (("stock", "camera-frame", ()), ("rigid", "fuse", ("stock",))):
        record = Run(time_ns, name, stage, input_runs=reads, outputs=(ChannelWritten(f"/runs/{name}/x", 0),))
        yield Message(f"/runs/{name}/record", time_ns + 8, time_ns, record)
    yield Message("/measurements", time_ns + 9, time_ns, Measurement(time_ns, "p001"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cut") / "whole.mcap"
    write_log(path, lab_messages())
    return path


def stock_rows(path: Path) -> list[Row]:
    """Return all messages but the records of cuts, read by the ``mcap`` package."""
    with path.open("rb") as file:
        rows = [
            Row(channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]
    return [row for row in rows if row.topic != "/cuts"]


def expected(rows: list[Row], keep: Callable[[Row], bool]) -> list[Row]:
    return [row for row in rows if row.topic in LASTING or keep(row)]


def camera_of(topic: str) -> str | None:
    return next((camera for camera in CAMERAS if f"/{camera}/" in topic), None)


def is_of_time(row: Row, start_s: float, end_s: float) -> bool:
    return START_NS + round(start_s * NS_PER_S) <= row.log_time_ns < START_NS + round(end_s * NS_PER_S)


def test_cut_by_time_equals_filter_with_mcap(whole: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.mcap"
    cut([whole], part, CutOptions(start="1.05", end="3"))
    rows = stock_rows(whole)
    assert stock_rows(part) == expected(rows, lambda row: is_of_time(row, 1.05, 3))
    # The same times as UTC, and their end is not included.
    again = tmp_path / "again.mcap"
    cut([whole], again, CutOptions(start="2023-11-14 22:13:21.050", end="2023-11-14T22:13:23Z"))
    assert stock_rows(again) == stock_rows(part)


@pytest.mark.parametrize(
    ("options", "keep"),
    [
        (CutOptions(topics=("/events",)), lambda row: row.topic == "/events"),
        (CutOptions(exclude_topics=("*/image", "/events")), lambda row: row.topic.startswith("/runs/")),
        (CutOptions(cameras=("red",)), lambda row: camera_of(row.topic) in (None, "red")),
        (CutOptions(runs=("stock",)), lambda row: not row.topic.startswith("/runs/rigid/")),
        # The record of the run that it has read comes with it, and its camera points do not.
        (CutOptions(runs=("rigid",)), lambda row: not row.topic.startswith("/runs/stock/")),
        (CutOptions(exclude_runs=("rigid",)), lambda row: not row.topic.startswith("/runs/rigid/")),
    ],
    ids=["topics", "exclude", "cameras", "runs", "runs_with_inputs", "exclude_runs"],
)
def test_cut_by_name_keeps_these_channels(
    whole: Path, tmp_path: Path, options: CutOptions, keep: Callable[[Row], bool]
) -> None:
    part = tmp_path / "part.mcap"
    cut([whole], part, options)
    rows = expected(stock_rows(whole), keep)
    if options.runs == ("stock",) or options.exclude_runs:
        rows = [row for row in rows if row.topic != "/runs/rigid/record"]
    assert stock_rows(part) == rows


def test_every_nth_frame_comes_with_its_results(whole: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.mcap"
    cut([whole], part, CutOptions(start="0.5", every=7))
    frames = {
        camera: [row.log_time_ns for row in stock_rows(whole) if row.topic == f"/cameras/{camera}/image"]
        for camera in CAMERAS
    }
    kept = {
        camera: [t for t in times if t >= START_NS + NS_PER_S // 2][::7] for camera, times in frames.items()
    }
    union = {*itertools.chain(*kept.values())}

    def keep(row: Row) -> bool:
        camera = camera_of(row.topic)
        if row.topic == "/events":
            return row.log_time_ns >= START_NS + NS_PER_S // 2
        return row.log_time_ns in (union if camera is None else kept[camera])

    assert stock_rows(part) == expected(stock_rows(whole), keep)


def test_robots_keep_the_frames_that_show_them(whole: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.mcap"
    cut([whole], part, CutOptions(robots=("b",)))
    with Session([whole]) as session:
        topics = [f"/runs/stock/cameras/{camera}/camera_points" for camera in CAMERAS]
        shown = {m.log_time_ns for m in session.messages(topics) if m.payload.points[0].id == 2}
    rows = expected(stock_rows(whole), lambda row: row.topic == "/events" or row.log_time_ns in shown)
    assert stock_rows(part) == rows
    assert 0 < len(shown) < len(CAMERAS) * FRAMES


PATTERNS = ("/events", "/cameras/*", "/runs/*", "*/image", "/runs/rigid/*", "*red*")


@settings(max_examples=40)
@given(
    start_s=st.one_of(st.none(), st.floats(0, 3.9)),
    length_s=st.one_of(st.none(), st.floats(0.2, 5)),
    topics=st.lists(st.sampled_from(PATTERNS), max_size=2),
    excluded=st.lists(st.sampled_from(PATTERNS), max_size=2),
    cameras=st.sets(st.sampled_from(CAMERAS)),
    overwritten=st.booleans(),
)
def test_part_is_the_filter_of_the_whole(
    whole: Path,
    start_s: float | None,
    length_s: float | None,
    topics: list[str],
    excluded: list[str],
    cameras: set[str],
    overwritten: bool,
) -> None:
    part = whole.with_name("hypothesis.mcap")
    if not overwritten:
        part.unlink(missing_ok=True)
    start_s = None if start_s is None else round(start_s, 3)
    end_s = None if length_s is None else round((start_s or 0) + length_s, 3)

    def keep(row: Row) -> bool:
        camera = camera_of(row.topic)
        return (
            is_of_time(row, start_s or 0, 1e6 if end_s is None else end_s)
            and (not topics or any(fnmatchcase(row.topic, pattern) for pattern in topics))
            and not any(fnmatchcase(row.topic, pattern) for pattern in excluded)
            and (not cameras or camera is None or camera in cameras)
        )

    options = CutOptions(
        start="" if start_s is None else str(start_s),
        end="" if end_s is None else str(end_s),
        topics=topics,
        exclude_topics=excluded,
        cameras=sorted(cameras),
    )
    wanted = expected(stock_rows(whole), keep)
    if len(wanted) == len(LASTING):
        before = part.read_bytes() if part.exists() else None
        with pytest.raises(IpsysError, match="no message is selected"):
            cut([whole], part, options, overwrite=True)
        assert (part.read_bytes() if part.exists() else None) == before
    else:
        cut([whole], part, options, overwrite=True)
        assert stock_rows(part) == wanted
    assert not list(part.parent.glob("*.partial"))


def test_two_logs_become_one_part(whole: Path, tmp_path: Path) -> None:
    """The channels of the second log have other ids in the part than in their log."""
    second, part = tmp_path / "second.mcap", tmp_path / "part.mcap"
    messages = (Message("/later", START_NS + n, START_NS, Event(START_NS, "gap", str(n))) for n in range(9))
    write_log(second, messages)
    cut([whole, second], part, CutOptions(end="2"))
    rows = expected(stock_rows(whole) + stock_rows(second), lambda row: is_of_time(row, 0, 2))
    assert sorted(stock_rows(part)) == sorted(rows)


@pytest.mark.parametrize("chunked", [True, False], ids=["chunks", "no_chunks"])
def test_log_of_another_program_keeps_attachments(tmp_path: Path, chunked: bool) -> None:
    log, part = tmp_path / "foreign.mcap", tmp_path / "part.mcap"
    with log.open("wb") as file:
        writer = Writer(file, use_chunking=chunked, chunk_size=200)
        writer.start("other", "test")
        schema = writer.register_schema("S", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
        writer.add_attachment(1, 2, "notes.txt", "text/plain", b"note " * 100)
        writer.add_metadata("lab", {"room": "7"})
        for number in range(50):
            # The times of a topic go back: the hash of the part needs the log order.
            time_ns = 1_000 + (number ^ 1)
            writer.add_message(channels[number % 2], time_ns, b"{}" + bytes([number]), time_ns)
        writer.finish()  # type: ignore[no-untyped-call, unused-ignore]
    cut([log], part, CutOptions(exclude_topics=("/b",)))
    assert stock_rows(part) == [row for row in stock_rows(log) if row.topic == "/a"]
    with part.open("rb") as file:
        reader = make_reader(io.BytesIO(file.read()))
        attached = [(one.name, one.media_type, one.data) for one in reader.iter_attachments()]
        rooms = [one.metadata for one in reader.iter_metadata() if one.name == "lab"]
    assert attached == [("notes.txt", "text/plain", b"note " * 100)]
    assert rooms == [{"room": "7"}]
    with Session([part]) as session:
        (one,) = (c for c in session.copies[session.readers[0]][0].channels if c.topic == "/a")
        assert one.kept_hash == session.hash("/a")


def test_video_is_cut_to_keyframes_only(tmp_path: Path) -> None:
    """A keyframe of H.264 has a unit of type 5, another frame one of type 1."""

    def picture(number: int, camera: str) -> CompressedVideo:
        kind = "65" if number % 10 == 0 else "41"
        return CompressedVideo(START_NS, camera, bytes.fromhex(f"00000001 {kind} 88"), "h264")

    log, part = tmp_path / "video.mcap", tmp_path / "part.mcap"
    write_log(log, lab_messages(picture))
    with pytest.raises(IpsysError, match=r"camera red has video.*--every"):
        cut([log], part, CutOptions(every=5))
    assert not part.exists()
    cut([log], part, CutOptions(every=10))
    with Session([part]) as session:
        assert session.count("/cameras/red/image") == FRAMES // 10
    cut([log], tmp_path / "without.mcap", CutOptions(every=5, exclude_topics=("*/image",)))


def test_damaged_chunk_is_not_copied(whole: Path, tmp_path: Path) -> None:
    log, part = tmp_path / "damaged.mcap", tmp_path / "part.mcap"
    data = bytearray(whole.read_bytes())
    data[data.index(bytes(80_000)) + 40_000] ^= 1
    log.write_bytes(data)
    with pytest.raises(IpsysError, match="CRC of the chunk is wrong"):
        cut([log], part, CutOptions())
    assert list(tmp_path.iterdir()) == [log]


def test_interrupt_leaves_no_file(whole: Path, tmp_path: Path) -> None:
    def interrupt(stage: str, done: int, total: int | None) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut([whole], tmp_path / "part.mcap", CutOptions(), progress=interrupt)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--camera", "green"), "has no camera 'green'; it has red, white"),
        (("--run", "best"), "has no run 'best'; it has rigid, stock"),
        (("--robot", "c"), "has no robot 'c'; it has a, b"),
        (("--topics", "/nothing"), "no topic fits '/nothing'; the log has /cameras/red/image"),
        (("--start", "99"), "has no message in the range; the log is from 2023-11-14 22:13:20.000"),
        (("--start", "3", "--end", "2"), "--end 2: is not after --start 3"),
        (("--start", "noon"), "--start noon: is no time; give seconds"),
        (("--end", "0"), "has no message in the range"),
    ],
    ids=["camera", "run", "robot", "topic", "range", "order", "time", "end"],
)
def test_refusal_names_the_known_values(
    ipsys: Ipsys, whole: Path, tmp_path: Path, arguments: tuple[str, ...], text: str
) -> None:
    done = ipsys("cut", whole, "-o", tmp_path / "part.mcap", *arguments)
    assert (done.code, done.out) == (1, "")
    assert text in done.err.replace("\n", " ")
    assert list(tmp_path.iterdir()) == []


def test_existing_log_needs_overwrite(ipsys: Ipsys, whole: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.mcap"
    assert ipsys("cut", whole, "-o", part, "--end", "2").code == 0
    before = part.read_bytes()
    refused = ipsys("cut", whole, "-o", part, "--end", "3")
    assert (refused.code, part.read_bytes()) == (1, before)
    assert "exists already" in refused.err
    assert ipsys("cut", whole, "-o", part, "--end", "3", "--overwrite").code == 0
    assert part.read_bytes() != before
    itself = ipsys("cut", part, "-o", part, "--overwrite")
    assert itself.code == 1
    assert "this is the log itself" in itself.err


def test_logs_with_equal_ids_are_refused(whole: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    write_log(other, [Message("/measurements", START_NS, START_NS, Measurement(START_NS, "p001"))])
    with pytest.raises(IpsysError, match="same id"):
        cut([whole, other], tmp_path / "part.mcap", CutOptions())


def test_two_schemas_of_one_topic_stay_apart(tmp_path: Path) -> None:
    log, part = tmp_path / "log.mcap", tmp_path / "part.mcap"
    for number, schema in enumerate((Schema("A", "jsonschema", b"{}"), Schema("A", "jsonschema", b"{ }"))):
        with LogWriter.append(log) if number else LogWriter.create(log) as writer:
            writer.add_channel("/a", schema, "json")
            writer.add_channel("/b", schema, "json")
            for n in range(3):
                writer.write("/a", 10 * number + n + 1, n, b"{}")
                writer.write("/b", 10 * number + n + 1, n, b"{}")
    cut([log], part, CutOptions(exclude_topics=("/b",)))

    def schemas(path: Path) -> list[bytes]:
        with path.open("rb") as file:
            return [schema.data for schema, *_ in make_reader(file).iter_messages(["/a"]) if schema]

    assert schemas(part) == schemas(log) == [b"{}"] * 3 + [b"{ }"] * 3
