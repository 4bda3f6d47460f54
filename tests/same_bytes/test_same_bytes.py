"""The comparison finds and names differences, and accepts the allowed ones."""

import json
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from tests.conftest import ROOT
from tests.same_bytes.allowed import AllowList
from tests.same_bytes.cases import Case, ipsys
from tests.same_bytes.differences import Difference, compare_json, compare_logs
from tests.same_bytes.run import Outcome, compare_case

Row = tuple[str, int, Message]


def pose(x: float, frame: str = "world") -> PoseInFrame:
    message = PoseInFrame(frame_id=frame)
    message.pose.position.x = x
    return message


def image(data: bytes) -> CompressedImage:
    return CompressedImage(frame_id="red", data=data, format="jpeg")


ROWS: list[Row] = [
    ("/poses", 10, pose(1.0)),
    ("/image", 20, image(b"abc")),
    ("/poses", 30, pose(2.0)),
    ("/image", 40, image(b"def")),
]


def write(path: Path, rows: list[Row], compression: CompressionType = CompressionType.ZSTD) -> Path:
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        for topic, time_ns, message in rows:
            if topic not in channels:
                described = FileDescriptorSet()
                _add(message.DESCRIPTOR.file, described)
                schema = writer.register_schema(
                    message.DESCRIPTOR.full_name, "protobuf", described.SerializeToString()
                )
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            writer.add_message(channels[topic], time_ns, message.SerializeToString(), time_ns - 1)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def _add(file: object, described: FileDescriptorSet) -> None:
    for needed in file.dependencies:  # type: ignore[attr-defined]
        if needed.name not in {one.name for one in described.file}:
            _add(needed, described)
    file.CopyToProto(described.file.add())  # type: ignore[attr-defined]


def differences(tmp_path: Path, rows: list[Row], messages_only: bool = False) -> list[Difference]:
    old, new = write(tmp_path / "old.mcap", ROWS), write(tmp_path / "new.mcap", rows)
    return compare_logs(old, new, messages_only)


def test_a_changed_field_is_named_with_both_values(tmp_path: Path) -> None:
    (found,) = differences(tmp_path, [*ROWS[:2], ("/poses", 30, pose(2.0 + 1e-15)), ROWS[3]])
    assert found.place == "/poses"
    assert found.text == ("1 of 2 messages differ; first at 30: pose.position.x: 2.0 -> 2.000000000000001")


def test_missing_messages_and_topics_are_counted(tmp_path: Path) -> None:
    rows: list[Row] = [*ROWS[:3], ("/more", 50, pose(0.0))]
    texts = {one.place: one.text for one in differences(tmp_path, rows)}
    assert texts["/image"] == "2 messages -> 1; the first without a counterpart at 40"
    assert texts["/more"] == "only in the new log, 1 message; first at 50"


def test_other_json_values_are_differences() -> None:
    found = compare_json({"a": 1, "b": [1, 2], "c": 1, "d": 0}, {"a": 2, "b": [1], "c": 1.0})
    assert [(one.place, one.text) for one in found.differences] == [
        ("a", "1 -> 2"),
        ("b", "2 elements -> 1"),
        ("c", "1 -> 1.0"),
        ("d", "0 -> absent"),
    ]


def outcome(folder: Path, files: dict[str, str], code: int = 0) -> Outcome:
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    hashes = {name: sha256(text.encode()).hexdigest() for name, text in files.items()}
    return Outcome(folder, [code], hashes, 1.0)


CASE = Case("info", (), (ipsys("info a.mcap --json"),))


def test_allowed_differences_are_accepted_and_unused_lines_named(tmp_path: Path) -> None:
    listed = tmp_path / "allowed.txt"
    listed.write_text("# why\ninfo runs.*.name a run got another name\ninfo /poses never\nreplay * other\n")
    allowed = AllowList.read(listed)
    old = outcome(tmp_path / "old", {"0.json": json.dumps({"runs": [{"name": "a"}]}), "x.csv": "1\n2\n"})
    new = outcome(tmp_path / "new", {"0.json": json.dumps({"runs": [{"name": "b"}]}), "x.csv": "1\n3\n"})
    result = compare_case(CASE, old, new, allowed)
    assert [one.place for one in result.allowed] == ["runs.0.name"]
    assert [(one.place, one.text) for one in result.differences] == [("x.csv", 'line 2: "2" -> "3"')]
    assert allowed.unused(["info"]) == [f"{listed}: line 3 is not used: info /poses"]


@pytest.mark.slow
def test_a_commit_equals_itself() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no git repository here")
    command = [sys.executable, "-m", "tests.same_bytes.run", "HEAD", "HEAD", "--only", "simulate", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [(case["state"], case["files"]) for case in report["cases"]] == [("equal", 2)]
