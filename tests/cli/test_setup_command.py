"""``ipsys setup``: its address, its end in order, and folders that cannot be used."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from ipsys_log.app.first_day.jobs import Job
from ipsys_log.app.web.server import PageServer
from ipsys_log.app.web.setup import SetupApp
from tests.conftest import Ipsys
from tests.playing import WAIT_LIMIT_S


@pytest.mark.slow
def test_command_serves_a_new_folder_and_ends_in_order(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ipsys_log", "setup", str(tmp_path / "lab"), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        line = program.stdout.readline()
        assert line.startswith("open http://127.0.0.1:")
        url = line.removeprefix("open ").strip()
        with urllib.request.urlopen(f"{url}api/state", timeout=WAIT_LIMIT_S) as answer:
            assert json.load(answer)["next"] == "rig"
        program.send_signal(signal.SIGINT)
        _, err = program.communicate(timeout=WAIT_LIMIT_S)
    assert program.returncode == 0, err
    assert "to continue: ipsys setup" in err
    assert err.splitlines()[0].endswith("--port 0")
    assert "Traceback" not in err
    assert (tmp_path / "lab").is_dir()


def test_used_port_leaves_no_folder(ipsys: Ipsys, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        done = ipsys("setup", tmp_path / "lab", "--port", other.getsockname()[1])
    assert (done.code, "is in use by another program" in done.err) == (1, True)
    assert not (tmp_path / "lab").exists()


def test_file_instead_of_a_folder_is_one_line(ipsys: Ipsys, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text("")
    done = ipsys("setup", tmp_path / "lab.toml")
    assert done.code == 1
    assert "is a file; name a folder" in done.err
    assert len(done.err.strip().splitlines()) == 1


def test_bug_in_a_job_ends_the_command_with_its_traceback(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    apps: list[SetupApp] = []
    make = SetupApp.__init__

    def keep(self: SetupApp, *given: object) -> None:
        make(self, *given)  # type: ignore[arg-type]
        apps.append(self)

    def breaks(_: Job) -> None:
        raise ZeroDivisionError("by zero")

    def wait(_: PageServer, stopped: Callable[[], bool]) -> None:
        apps[0].session.jobs.start("the fit", breaks)

    monkeypatch.setattr(SetupApp, "__init__", keep)
    monkeypatch.setattr(PageServer, "wait", wait)
    done = ipsys("setup", tmp_path / "lab", "--port", 0)
    assert done.code == 1
    assert "ZeroDivisionError: by zero" in done.err
