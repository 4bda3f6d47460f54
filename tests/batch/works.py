"""Works for the tests of batches: they end their worker, wait, or fill a disk. Workers import this module."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from ipsys_log.batch.tasks import LogResult, replay_log

# A generous limit: a wait ends with an event.
PATIENCE_S = 1800.0
DEADLY = "deadly.mcap"
HELD = "held.mcap"


def wait_for(path: Path) -> None:
    """Wait until a file exists and has a content."""
    end_s = time.monotonic() + PATIENCE_S
    while not (path.exists() and path.read_text()):
        assert time.monotonic() < end_s, f"{path} did not appear"
        time.sleep(0.05)


def replay_and_note(path: Path, notes: Path) -> LogResult:
    """Replay a log; note each start. One log ends each of its workers, another one waits to be killed."""
    with (notes / f"{path.stem}.starts").open("a") as file:
        file.write("x")
    if path.name == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    if path.name == HELD and not (notes / "killed").exists():
        (notes / "killed").write_text("soon")
        # The replay is in its middle: the log has some of its runs.
        replay_log(path, until="camera-frame")
        (notes / "pid").write_text(str(os.getpid()))
        time.sleep(PATIENCE_S)
    return replay_log(path, models=("rigid",))
