"""The work of the tests of pieces: it notes each start of a piece, ends its worker, or waits to be killed.

Each worker that gets a task of this work imports this module. The environment names the folder for notes.
"""

import os
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ipsys_log.api.batch.log_work import replay_log
from ipsys_log.api.batch.tasks import LogResult, compute_alone
from ipsys_log.engine import pieces
from ipsys_log.engine.pieces import Piece, PieceResult, PieceRun
from ipsys_log.log.location import LogLocation
from tests.batch.works import DEADLY, HELD, PATIENCE_S, is_first

NOTES = "IPSYS_TEST_NOTES"
# Short enough for several pieces of each camera in a small log.
PARAMETERS = {"reset_s": "2"}
UNTIL = "camera-frame"


def replay_pieces(path: LogLocation, **options: Any) -> LogResult:
    """Replay a small log as a long one."""
    return replay_log(path, until=UNTIL, parameters=PARAMETERS, **options)


def compute_and_note(run: PieceRun, piece: Piece, software: Mapping[str, str]) -> PieceResult:
    """Compute a piece. The first piece of one log ends each worker; that of another log waits once."""
    notes = Path(os.environ[NOTES])
    log, key = Path(str(run.paths[0])).name, f"{piece.camera}-{piece.start_ns}"
    with (notes / f"{log}-{key}").open("a") as file:
        file.write("x")
    if log == DEADLY:
        with suppress(FileExistsError):  # the first piece that starts
            (notes / "deadly_piece").symlink_to(key)
        if str((notes / "deadly_piece").readlink()) == key:
            os.kill(os.getpid(), signal.SIGKILL)
    if log == HELD and is_first(notes / "killed", key):
        (notes / "pid").write_text(str(os.getpid()))
        time.sleep(PATIENCE_S)
    return compute_alone(run, piece, software)


if NOTES in os.environ:
    pieces._MIN_FRAMES = 1
