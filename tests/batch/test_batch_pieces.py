"""Long logs in batches with real workers: the bytes of one process, and killed workers during a piece."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.api import python_api as api
from tests.batch.piece_works import NOTES, PARAMETERS, UNTIL
from tests.batch.works import HELD, PATIENCE_S, one_worker_killed
from tests.conftest import ROOT

pytestmark = pytest.mark.slow
pytest.importorskip("distributed", reason="no Dask: pip install 'ipsys_log[batch]'")


@pytest.fixture(scope="module")
def replayed(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the bytes of the log after the single command in one process."""
    log = Path(shutil.copy(lab_log, tmp_path_factory.mktemp("single") / "log.mcap"))
    api.replay(log, until=UNTIL, parameters=PARAMETERS, jobs=1)
    return log.read_bytes()


def drive(logs: list[Path], notes: Path, workers: int) -> dict[str, Any]:
    """Replay logs in pieces by a separate program; return the results by name."""
    notes.mkdir()
    request = {
        "logs": logs,
        "notes": notes,
        "workers": {"workers": workers},
        "tasks": workers,
        "pieces": True,
    }
    done = subprocess.run(
        [sys.executable, "-m", "tests.batch.driver", json.dumps(request, default=str)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE_S,
        check=False,
        env={**os.environ, NOTES: str(notes)},
    )
    assert done.returncode == 0, done.stderr
    return {Path(result["log"]).name: result for result in json.loads(done.stdout)["results"]}


def starts(notes: Path, log: str) -> dict[str, int]:
    """Return the number of starts of each piece of a log."""
    return {path.name.removeprefix(f"{log}-"): len(path.read_text()) for path in notes.glob(f"{log}-*")}


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_pieces_on_workers_give_the_bytes_of_one_process(
    lab_log: Path, tmp_path: Path, replayed: bytes, workers: int
) -> None:
    log = Path(shutil.copy(lab_log, tmp_path / "log.mcap"))
    (result,) = drive([log], tmp_path / "notes", workers).values()
    assert result["state"] == "computed", result
    assert set(starts(tmp_path / "notes", "log.mcap").values()) == {1}
    assert len(starts(tmp_path / "notes", "log.mcap")) == result["pieces"] > 5
    assert log.read_bytes() == replayed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.mcap", "notes"]


def test_killed_worker_costs_only_its_piece(lab_log: Path, tmp_path: Path, replayed: bytes) -> None:
    """A piece whose worker is killed in its middle is done again, and no other piece."""
    log = Path(shutil.copy(lab_log, tmp_path / HELD))
    notes = tmp_path / "notes"
    with one_worker_killed(notes):
        results = drive([log], notes, workers=2)
    counts = starts(notes, HELD)
    assert results[HELD]["state"] == "computed", results
    assert {key for key, count in counts.items() if count > 1} == {(notes / "killed").read_text()}
    assert log.read_bytes() == replayed
