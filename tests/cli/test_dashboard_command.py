"""``ipsys live --web``: its addresses, its refusals, and its events in the log."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import EVENTS
from ipsys_log.messages.events import MARK
from tests.conftest import Ipsys
from tests.playing import WAIT_LIMIT_S
from tests.test_bad_input import refused
from tests.test_extras import CAMERA, RIG
from tests.waiting import wait_until
from tests.web.test_access import Caller
from tests.web.test_dashboard_page import cookie_of, post


@pytest.fixture
def folder(tmp_path: Path, calibration: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a rig of simulated cameras and the model of another log."""
    (tmp_path / "lab.toml").write_text(RIG + "".join(CAMERA.format(name) for name in ("red", "white")))
    shutil.copy(calibration, tmp_path / "model.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


LIVE = ("live", "--model-from", "model.mcap", "-o", "live.mcap")


def test_options_of_the_page_without_the_page_are_refused(ipsys: Ipsys, folder: Path) -> None:
    model = folder / "model.mcap"
    assert "--web-port: has no effect without --web; add --web" in refused(
        ipsys, model, *LIVE, "--web-port", "8000"
    )
    assert "--host: has no effect without a stream" in refused(ipsys, model, *LIVE, "--host", "127.0.0.1")


def test_port_in_use_is_named_before_the_cameras_are_opened(ipsys: Ipsys, folder: Path) -> None:
    model = folder / "model.mcap"
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert f"--web-port {port}: is in use by another program" in refused(
            ipsys, model, *LIVE, "--web", "--web-port", port
        )


def lines_of(program: subprocess.Popen[str], pattern: str) -> Iterator[str]:
    """Yield the lines on stderr up to the first one with a pattern."""
    assert program.stderr is not None
    for line in program.stderr:
        yield line
        if re.search(pattern, line):
            return
    raise AssertionError(f"no line with {pattern}")


# A recording in real time, in a process of its own.
@pytest.mark.slow
def test_addresses_to_view_and_to_operate_are_printed(folder: Path) -> None:
    options = ("--web", "--web-port", "0", "--host", "127.0.0.1")
    command = [sys.executable, "-m", "ipsys_log", *LIVE, *options]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder
    ) as program:
        try:
            *_, view_line, operate_line = lines_of(program, "to operate")
            view, operate = (line.split()[-1] for line in (view_line, operate_line))
            caller, cookie = Caller(operate), cookie_of(operate)
            assert json.loads(caller.ask("GET", "/api/scene", **cookie_of(view))[1])["may_operate"] is False
            number = post(caller, "/api/operate", {}, **cookie)[1]["operator"]
            mark = {"operator": number, "text": "pushed"}
            # A request before the first frame is refused; the cameras are opened before the page is served.
            wait_until(lambda: post(caller, "/api/mark", mark, **cookie)[0] == 200, "a mark is accepted")
            assert any("mark: pushed" in line for line in lines_of(program, "mark: pushed"))
            program.send_signal(signal.SIGTERM)
            out, err = program.communicate(timeout=WAIT_LIMIT_S)
        finally:
            program.kill()
    assert program.returncode == 0, err
    # Two codes beside each other, with their captions.
    assert max(map(len, out.splitlines())) <= 80
    assert re.search(r"^view +operate$", out, re.MULTILINE)
    with Session([folder / "live.mcap"]) as session:
        events = session.payloads(session.topics(EVENTS))
    assert [event.text for event in events if event.kind == MARK] == ["pushed"]
