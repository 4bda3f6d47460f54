"""The viewer's process: local to this machine, fed by a pipe, with failures in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.sinks.rerun import viewer
from ipsys_log.sinks.rerun.viewer import check_screen, show_in_viewer, viewer_command


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
