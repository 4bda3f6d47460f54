"""The terminal report of a repaired log."""

import io
import os
from collections.abc import Sequence
from pathlib import Path

import pytest
from rich.console import Console

from ipsys_log.app.report.checks import repair_lines
from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter

IMAGE = Schema("foxglove.CompressedImage", "protobuf", b"")
NOTE = Schema("ipsys.v1.Event", "protobuf", b"")
START_NS = 1_500_000_000_000_000_000  # 02:40:00
FRAME_NS = 50_000_000


def recorded(path: Path, frames: int) -> Path:
    with LogWriter.create(path) as writer:
        for topic in ("/cameras/red/image", "/cameras/white/image"):
            writer.add_channel(topic, IMAGE)
        writer.add_channel("/events", NOTE)
        writer.write("/events", START_NS, START_NS, b"note")
        for n in range(frames):
            now_ns = START_NS + n * FRAME_NS
            for more_ns, topic in enumerate(("/cameras/red/image", "/cameras/white/image")):
                writer.write(topic, now_ns + more_ns, now_ns, bytes([1 + n]) * 2_000)
    return path


def lines(path: Path) -> list[str]:
    console = Console(width=80, record=True, file=io.StringIO())
    for part in repair_lines(repair(path)):
        console.print(part, markup=False, highlight=False)
    text = console.export_text()
    assert all(len(line) <= 80 for line in text.splitlines())
    return [" ".join(line.split()) for line in text.splitlines()]


def killed(path: Path, tmp_path: Path, written_ns: int) -> Path:
    """Return a log that is cut in its last frames, with a given time of the last write."""
    with LogReader(path) as log:
        last = max(c.end for c in log._contents.chunks if not c.compression)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: last - 5_000])
    os.utime(cut, ns=(written_ns, written_ns))
    return cut


def test_report_counts_the_messages_of_a_killed_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cut = killed(recorded(Path("a.mcap"), 50), Path(), START_NS + 2_700_000_000)
    said = lines(cut)
    with LogReader(cut) as log:
        counts = [log.channels[f"/cameras/{name}/image"].message_count for name in ("red", "white")]
    assert 90 < sum(counts) < 100
    assert said[0].startswith(f"cut.mcap repaired: {sum(counts) + 1} messages, up to 2017-07-14 02:40:02.")
    # The rate is 20 Hz, from the last kept frame to one second after the last write.
    for name, count in zip(("red", "white"), counts, strict=True):
        last_ns = (count - 1) * FRAME_NS
        gone = -(-(3_700_000_000 - last_ns) // FRAME_NS)
        clock = f"02:40:{last_ns / 1e9:06.3f}"
        assert f"/cameras/{name}/image {count} {clock} {gone} at 20.0/s" in said
    assert "/events 1 02:40:00.000" in said
    assert "The file was last written at 02:40:02.700 UTC. Later messages are lost:" in said


def test_copied_log_has_an_unknown_end_time(tmp_path: Path) -> None:
    cut = killed(recorded(tmp_path / "a.mcap", 50), tmp_path, START_NS + 10**14)
    said = lines(cut)
    assert said[-1].startswith("The end of the log is lost. Its time is unknown")
    assert sum(line.endswith("not known") for line in said if line.startswith("/")) == 2


def test_a_whole_log_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert lines(recorded(Path("a.mcap"), 5)) == ["a.mcap is undamaged and unchanged: 11 messages"]


def found(said: Sequence[str], topic: str) -> list[str]:
    return [line for line in said if line.startswith(topic)]


def test_messages_of_a_damaged_part_are_listed(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.mcap", 50)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 9_000] = b"\xff" * 9_000
    path.write_bytes(data)
    said = lines(path)
    assert any("cannot be read; these messages are lost:" in line for line in said)
    with LogReader(path) as log:
        for name in ("red", "white"):
            (line,) = found(said, f"/cameras/{name}/image")
            assert int(line.split()[1]) == 50 - log.channels[f"/cameras/{name}/image"].message_count > 0
    assert not any("last written" in line for line in said)


def test_bytes_cut_away_are_named_with_unknown_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cut = killed(recorded(Path("a.mcap"), 50), Path(), START_NS + 2_700_000_000)
    data = bytearray(cut.read_bytes())
    data[-9_000:] = b"\xff" * 9_000
    cut.write_bytes(data)
    said = lines(cut)
    assert any("cannot be read; the number of messages in these bytes is not known" in line for line in said)
    assert "the old data are in cut.mcap.damaged" in said
    assert not any("no whole message" in line for line in said)


def test_messages_saved_without_crc_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = lines(killed(recorded(Path("a.mcap"), 50), Path(), START_NS + 2_700_000_000))
    (line,) = (line for line in said if "from damaged parts" in line)
    assert 0 < int(line.split()[0]) < 100


def test_frames_without_rig_are_named_with_a_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cut = killed(recorded(Path("a.mcap"), 50), Path(), START_NS + 2_700_000_000)
    assert "the log has frames but no rig: give one to each command (--rig lab.toml)" in lines(cut)
    path = recorded(Path("b.mcap"), 5)
    with LogWriter.append(path) as writer:
        writer.add_channel("/rig", Schema("ipsys.v1.Rig", "protobuf", b""))
        writer.write("/rig", START_NS, START_NS, b"rig")
    path.write_bytes(path.read_bytes()[:-40])
    assert not any("no rig" in line for line in lines(path))
