"""Works for the tests of batches: they end their worker, wait, or fill a disk. Workers import this module."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ipsys_log.api.batch.log_work import replay_log
from ipsys_log.api.batch.tasks import LogResult
from tests.waiting import wait_until

# A generous limit: a wait ends with an event.
PATIENCE_S = 1800.0
DEADLY = "deadly.mcap"
HELD = "held.mcap"


def wait_for(path: Path) -> None:
    """Wait until a file exists and has a content."""
    wait_until(lambda: path.exists() and path.read_text(), f"{path} has a content")


def read_json(path: Path) -> Any:
    """Wait until another program has written a complete JSON file; return its content."""
    read: list[Any] = []

    def is_complete() -> bool:
        with suppress(FileNotFoundError, ValueError):  # the other program has not written it all
            read.append(json.loads(path.read_text()))
        return bool(read)

    wait_until(is_complete, f"{path} is complete")
    return read[0]


@contextmanager
def one_worker_killed(notes: Path) -> Iterator[None]:
    """Kill the worker that notes its process, by its id, while the block runs."""

    def kill() -> None:
        wait_for(notes / "pid")
        os.kill(int((notes / "pid").read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    yield
    killer.join()


def batch(folder: Path, *arguments: object) -> tuple[int, Any, str]:
    """Run a command of the group as a program; return its exit code, its JSON and its errors."""
    done = subprocess.run(
        [sys.executable, "-m", "ipsys_log", "batch", *map(str, arguments), "--json"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return done.returncode, json.loads(done.stdout) if done.stdout else None, done.stderr


def is_first(note: Path, text: str) -> bool:
    """Return True in the one process that writes the note first."""
    try:
        with note.open("x") as file:
            file.write(text)
    except FileExistsError:
        return False
    return True


def replay_and_note(path: Path, notes: Path) -> LogResult:
    """Replay a log; note each start. One log ends each of its workers, another one waits to be killed."""
    with (notes / f"{path.stem}.starts").open("a") as file:
        file.write("x")
    if path.name == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    if path.name == HELD and is_first(notes / "killed", path.name):
        # The replay is in its middle: the log has some of its runs.
        replay_log(path, until="camera-frame")
        (notes / "pid").write_text(str(os.getpid()))
        time.sleep(PATIENCE_S)
    return replay_log(path, models=("rigid",))
