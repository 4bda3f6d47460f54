"""``ipsys live --web``: its addresses, its refusals, and its events in the log."""

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import pytest
from rich.console import Console

from ipsys_log.app.cli import pages
from ipsys_log.app.cli.pages import _print_addresses
from ipsys_log.app.first_day.jobs import Job
from ipsys_log.app.web.server import PageServer, ServerExceptions, qr_code
from ipsys_log.app.web.setup import SetupApp
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


VIEW, OPERATE = "http://10.0.0.7:8000/?key=abc", "http://10.0.0.7:8000/?key=def"


def printed(
    monkeypatch: pytest.MonkeyPatch, width: int, url: str, view_url: str | None, is_secret: bool
) -> tuple[list[str], list[str]]:
    """Return the lines of the output and those of the remarks."""
    shown, said = Console(width=width, record=True), Console(width=200, record=True)
    monkeypatch.setattr(pages, "console", shown)
    monkeypatch.setattr("ipsys_log.app.cli.console.remarks", said)
    _print_addresses(PageServer(url, Thread(), ServerExceptions(), view_url), is_secret)
    return shown.export_text().splitlines(), said.export_text().splitlines()


def test_address_of_this_machine_has_no_code(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, said = printed(monkeypatch, 80, "http://127.0.0.1:8000/", None, False)
    assert (shown, said) == ([], ["dashboard at http://127.0.0.1:8000/"])


def test_one_secret_has_one_code(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, said = printed(monkeypatch, 80, VIEW, None, True)
    assert shown == qr_code(VIEW).splitlines()
    assert said == [f"dashboard at {VIEW}"]


@pytest.mark.parametrize("width", [60, 80])
def test_two_secrets_have_two_codes_with_their_names(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    shown, said = printed(monkeypatch, width, OPERATE, VIEW, True)
    assert said == [f"dashboard, to view:    {VIEW}", f"dashboard, to operate: {OPERATE}"]
    view, operate = (qr_code(url).splitlines() for url in (VIEW, OPERATE))
    assert max(map(len, shown)) <= width
    if width == 60:  # too narrow for two codes side by side
        assert shown == [*view, "view", *operate, "operate"]
    else:
        assert shown[-1].split() == ["view", "operate"]
        assert all(line.startswith(code) for line, code in zip(shown, view, strict=False))
        assert all(line.endswith(code) for line, code in zip(shown, operate, strict=False))


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
