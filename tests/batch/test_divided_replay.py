"""A divided replay in one process: its pieces after an error of a later stage, and after a full disk."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest

from ipsys_log.batch.log_work import replay_log
from ipsys_log.batch.tasks import BatchTask, LogPieces, LogResult, perform_or_divide, perform_piece
from ipsys_log.errors import IpsysError, WriteError
from ipsys_log.log.dataset import Session
from ipsys_log.runs import output, pieces
from ipsys_log.stages.camera_frame import CameraFrame
from tests.batch.piece_works import PARAMETERS, UNTIL

# Detection in a rendered log.
pytestmark = pytest.mark.slow

TASK = BatchTask(replay_log, {"until": UNTIL, "parameters": PARAMETERS}, divides=True)


@pytest.fixture
def log(lab_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a log whose pieces are stored."""
    monkeypatch.setattr(pieces, "_MIN_FRAMES", 1)
    log = Path(shutil.copy(lab_log, tmp_path / "log.mcap"))
    divided = perform_or_divide(TASK, log)
    assert isinstance(divided, LogPieces)
    for piece in divided.tasks:
        assert perform_piece(TASK, log, piece).failure is None
    return log


def stages_of(log: Path) -> list[str]:
    with Session([log]) as session:
        return [run.stage for run in session.runs()]


def stored(log: Path) -> list[str]:
    return sorted(file.name for file in log.with_name("log.mcap.pieces").glob("*"))


def test_pieces_are_deleted_if_only_a_later_stage_fails(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise IpsysError("the rig has no marker length")

    monkeypatch.setattr(CameraFrame, "_frame", fail)
    result = perform_or_divide(TASK, log)
    assert isinstance(result, LogResult)
    assert (result.good, result.text) == (False, "the rig has no marker length")
    assert (stages_of(log), stored(log)) == (["detect"], [])


def test_pieces_stay_if_the_disk_is_full(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, kept = log.read_bytes(), stored(log)

    def fail(*_: object) -> None:
        raise WriteError(f"{log}: no space left", OSError(errno.ENOSPC, "no space left"))

    with monkeypatch.context() as patch:
        patch.setattr(output, "record_message", fail)
        result = perform_or_divide(TASK, log)
    assert isinstance(result, LogResult)
    assert (result.good, log.read_bytes(), stored(log)) == (False, before, kept)
    # With room, nothing is computed again.
    result = perform_or_divide(TASK, log)
    assert isinstance(result, LogResult)
    assert (result.state, result.pieces) == ("computed", len(kept))
    assert (stages_of(log), stored(log)) == (["detect", "camera-frame"], [])
