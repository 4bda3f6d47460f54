"""Rerun reads the live recording, without a screen."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Message, Tracks
from ipsys_log.sinks.rerun import viewer
from ipsys_log.sinks.rerun.viewer import LiveView, check_screen, show_in_viewer, viewer_command
from ipsys_log.sinks.streams.poses import NewSession

Write = Callable[[bytes], object]


def replayed(log: Path) -> tuple[list[Message], Session]:
    session = Session([log])
    topics = {t for reader in session.readers for t in reader.channels if "/truth" not in t}
    return [m for m in session.messages(topics) if isinstance(m.payload, CompressedImage | Tracks)], session


def test_frames_and_robots_arrive_in_rerun(replayed_log: Path, tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"

    def show(feed: Callable[[Write], None]) -> None:
        with path.open("wb") as file:
            feed(file.write)

    messages, session = replayed(replayed_log)
    (rig,) = session.payloads(["/rig"])
    LiveView(rig, session.images, "poly", print, show).consume(iter([*messages, None]))
    # The pipe to a viewer has a table of contents after every part; a file has one.
    whole = tmp_path / "whole.rrd"
    command = [sys.executable, "-m", "rerun", "rrd", "merge", str(path), "-o", str(whole)]
    subprocess.run(command, check=True, capture_output=True)
    entities = {chunk.entity_path for chunk in RrdReader(whole).stream().to_chunks()}
    assert {f"/cameras/{camera}/image" for camera in session.images} <= entities
    assert any(entity.startswith("/world/runs/poly/robots/robot_") for entity in entities)


def test_session_of_a_playback_is_a_recording_of_its_own(replayed_log: Path, tmp_path: Path) -> None:
    """Times go back after a loop: in one recording, trails and cleared entities would be wrong."""
    messages, session = replayed(replayed_log)
    tracks = [message for message in messages if isinstance(message.payload, Tracks)]
    (rig,) = session.payloads(["/rig"])
    parts: list[bytes] = []
    begin = [Message("", 0, 0, NewSession(number)) for number in (1, 2)]
    view = LiveView(rig, (), "poly", print, lambda feed: feed(parts.append), "Rerun")
    assert not isinstance(messages[0].payload, view.payloads)
    view.consume(iter([begin[0], *tracks, begin[1], *tracks[:3]]))
    path = tmp_path / "live.rrd"
    path.write_bytes(b"".join(parts))
    whole = tmp_path / "whole.rrd"
    command = [sys.executable, "-m", "rerun", "rrd", "merge", str(path), "-o", str(whole)]
    subprocess.run(command, check=True, capture_output=True)
    assert len(list(RrdReader(whole).recordings())) == 2


def test_missing_screen_is_reported_before_the_recording(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with Session([lab]) as session:
        (rig,) = session.payloads(["/rig"])
        with pytest.raises(IpsysError, match="needs a screen"):
            LiveView(rig, session.images, None, print)


def test_viewer_failure_is_reported_with_its_reason(lab: Path) -> None:
    def broken(feed: Callable[[Write], None]) -> None:
        raise IpsysError("the viewer cannot be shown")

    said: list[str] = []
    with Session([lab]) as session:
        (rig,) = session.payloads(["/rig"])
        LiveView(rig, session.images, None, said.append, broken).consume(iter([]))
    assert said == ["the viewer cannot be shown"]


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")


def stand_in(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.setattr(viewer, "viewer_command", lambda: [sys.executable, "-c", program])


def pieces(data: bytes, count: int) -> Callable[[Callable[[bytes], object]], None]:
    def feed(write: Callable[[bytes], object]) -> None:
        for _ in range(count):
            write(data)

    return feed


def test_only_this_machine_can_connect() -> None:
    command = viewer_command()
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert command[command.index("--port") + 1] == "auto"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is always a screen")
def test_missing_screen_error_names_an_alternative() -> None:
    with pytest.raises(IpsysError, match="--save"):
        check_screen({"HOME": "/"})
    check_screen({"WAYLAND_DISPLAY": "wayland-0"})


def test_all_bytes_reach_the_viewer(screen: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "got"
    stand_in(
        monkeypatch, f"import sys, pathlib; pathlib.Path({str(path)!r}).write_bytes(sys.stdin.buffer.read())"
    )
    show_in_viewer(pieces(b"a" * 100_000, 3))
    assert path.read_bytes() == b"a" * 300_000


def test_viewer_that_cannot_open_says_why_in_one_line(screen: None, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, "import sys; print('\\x1b[31mno GPU\\x1b[0m', file=sys.stderr); sys.exit(1)")
    with pytest.raises(IpsysError, match=r"\(no GPU\).*--save"):
        show_in_viewer(pieces(bytes(1 << 20), 8))


def test_window_closed_early_is_no_error(screen: None, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, "import sys; sys.stdin.buffer.read(10)")
    taken: list[int] = []

    def feed(write: Callable[[bytes], object]) -> None:
        for number in range(8):
            write(bytes(1 << 20))
            taken.append(number)

    show_in_viewer(feed)
    assert len(taken) < 8  # the other keys were not sent to a closed window


def test_viewer_ends_when_reading_fails(screen: None, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, "import time; time.sleep(60)")

    def feed(write: object) -> None:
        raise IpsysError("damaged")

    with pytest.raises(IpsysError, match="damaged"):
        show_in_viewer(feed)
