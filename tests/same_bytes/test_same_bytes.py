"""The comparison finds and names differences, and accepts the allowed ones."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from tests.conftest import ROOT
from tests.same_bytes.allowed import AllowList, AllowListError
from tests.same_bytes.cases import CASES, Case, ipsys
from tests.same_bytes.differences import Difference, compare_json, compare_logs
from tests.same_bytes.inputs import MADE, Inputs, MissingInputError, UnmadeInputError
from tests.same_bytes.run import CaseResult, Outcome, compare_case, main, report_lines

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


def test_equal_logs_have_no_difference(tmp_path: Path) -> None:
    assert differences(tmp_path, list(ROWS)) == []


def test_a_changed_field_is_named_with_both_values(tmp_path: Path) -> None:
    (found,) = differences(tmp_path, [*ROWS[:2], ("/poses", 30, pose(2.0 + 1e-15)), ROWS[3]])
    assert found.place == "/poses"
    assert found.text == ("1 of 2 messages differ; first at 30: pose.position.x: 2.0 -> 2.000000000000001")


def test_changed_bytes_are_named_by_their_hash(tmp_path: Path) -> None:
    (found,) = differences(tmp_path, [*ROWS[:3], ("/image", 40, image(b"other"))])
    digests = sha256(b"def").hexdigest()[:12], sha256(b"other").hexdigest()[:12]
    assert found.text.endswith(f"data: 3 bytes {digests[0]} -> 5 bytes {digests[1]}")


def test_the_first_difference_in_the_log_comes_first(tmp_path: Path) -> None:
    rows = [("/poses", 10, pose(1.0, "other")), ("/image", 20, image(b"x")), *ROWS[2:]]
    assert [one.place for one in differences(tmp_path, rows)] == ["/poses", "/image"]
    rows = [ROWS[0], ("/image", 20, image(b"x")), ("/poses", 30, pose(5.0)), ROWS[3]]
    assert [one.place for one in differences(tmp_path, rows)] == ["/image", "/poses"]


def test_missing_messages_and_topics_are_counted(tmp_path: Path) -> None:
    rows: list[Row] = [*ROWS[:3], ("/more", 50, pose(0.0))]
    texts = {one.place: one.text for one in differences(tmp_path, rows)}
    assert texts["/image"] == "2 messages -> 1; the first without a counterpart at 40"
    assert texts["/more"] == "only in the new log, 1 message; first at 50"


def test_times_are_compared(tmp_path: Path) -> None:
    (found,) = differences(tmp_path, [*ROWS[:3], ("/image", 41, image(b"def"))])
    assert found.text == "1 of 2 messages differ; first at 40: log time -> 41"


def test_order_counts_only_in_logs_of_one_writer(tmp_path: Path) -> None:
    rows = [ROWS[1], ROWS[0], *ROWS[2:]]
    assert [one.place for one in differences(tmp_path, rows)] == ["order"]
    assert differences(tmp_path, rows, messages_only=True) == []


def test_other_chunks_are_a_difference_of_bytes(tmp_path: Path) -> None:
    old = write(tmp_path / "old.mcap", ROWS)
    new = write(tmp_path / "new.mcap", ROWS, CompressionType.NONE)
    assert [one.place for one in compare_logs(old, new)] == ["bytes"]
    assert compare_logs(old, new, messages_only=True) == []


def test_a_damaged_log_is_a_difference(tmp_path: Path) -> None:
    old = write(tmp_path / "old.mcap", ROWS)
    new = tmp_path / "new.mcap"
    new.write_bytes(old.read_bytes()[:-40])
    assert [one.place for one in compare_logs(old, new)] == ["bytes"]


def test_new_json_keys_are_additions() -> None:
    found = compare_json({"runs": [{"a": 1}]}, {"runs": [{"a": 1, "b": 2}], "c": 3})
    assert found.differences == []
    assert found.additions == ["c", "runs.0.b"]


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


def test_an_allowed_line_without_a_reason_is_refused(tmp_path: Path) -> None:
    (tmp_path / "allowed.txt").write_text("replay /poses\n")
    with pytest.raises(AllowListError, match="line 1: write CASE PLACE REASON"):
        AllowList.read(tmp_path / "allowed.txt")


def test_a_command_that_fails_with_both_is_a_difference(tmp_path: Path) -> None:
    old, new = outcome(tmp_path / "old", {}, 1), outcome(tmp_path / "new", {}, 1)
    (found,) = compare_case(CASE, old, new, AllowList()).differences
    assert (found.place, found.text) == ("exit-code", "info a.mcap: fails with both, 1")


def test_files_of_one_side_only_are_differences(tmp_path: Path) -> None:
    old, new = outcome(tmp_path / "old", {"a.yaml": ""}), outcome(tmp_path / "new", {"b.yaml": ""})
    found = compare_case(CASE, old, new, AllowList()).differences
    assert [(one.place, one.text) for one in found] == [
        ("a.yaml", "only old writes it"),
        ("b.yaml", "only new writes it"),
    ]


def test_the_report_begins_with_the_answer() -> None:
    many = [Difference(f"/topic_{n}", "1 of 2 messages differ", "a.mcap") for n in range(20)]
    many.append(Difference("runs.0", "1 -> 2", "0.json"))
    equal = CaseResult("equal", files=3, outputs=1)
    different = replace(equal, case="different", differences=many)
    lines = list(report_lines([equal, different], ("a" * 40, "b" * 40), 60.0, []))
    assert lines[0] == "DIFFERENT: 1 of 2 cases; aaaaaaaaaa -> bbbbbbbbbb; 60 s"
    details = lines[lines.index("different") + 1 :]
    assert len(details) == 10
    assert details[:2] == ["  a.mcap: /topic_0: 1 of 2 messages differ", "  0.json: runs.0: 1 -> 2"]
    assert details[-1] == "  and 12 more"
    assert next(report_lines([equal], ("a" * 40, "b" * 40), 60.0, [])).startswith("equal: 1 cases, 3 files")


def test_cases_have_names_of_their_own() -> None:
    names = [case.name for case in (*CASES, *MADE.values())]
    assert len(set(names)) == len(names)


def test_inputs_not_at_hand_and_not_made_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "inputs").mkdir()
    inputs = Inputs(tmp_path / "inputs", tmp_path / "tree", lambda case: tmp_path / case.name)
    with pytest.raises(MissingInputError, match=r"v9_9_9\.mcap"):
        inputs.make(["v9_9_9.mcap"])
    with pytest.raises(UnmadeInputError, match=r"lab\.mcap: the old commit does not make it: ipsys simulate"):
        inputs.make(["sheet.csv"])


@pytest.mark.parametrize("wrong", [["no-such-commit", "HEAD"], ["HEAD", "HEAD", "--only", "no-such-case"]])
def test_wrong_usage_ends_with_code_2(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(wrong)
    assert stop.value.code == 2
    assert "no such" in capsys.readouterr().err


@pytest.mark.slow
def test_a_commit_equals_itself() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no git repository here")
    command = [sys.executable, "-m", "tests.same_bytes.run", "HEAD", "HEAD", "--only", "simulate", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [(case["state"], case["files"]) for case in report["cases"]] == [("equal", 2)]
