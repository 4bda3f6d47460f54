"""Batches and catalogues of logs in an S3 server on loopback: derived logs, pieces, and changed objects."""

import json
import os
import pickle
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.api import python_api as api
from ipsys_log.api.batch.log_work import check_log, export_log, replay_log, verify_log
from ipsys_log.api.batch.tasks import BatchTask, LogResult, compute_alone, perform
from ipsys_log.engine import pieces
from ipsys_log.engine.pieces import PiecePlan, PieceResult
from ipsys_log.engine.provenance import fingerprint
from ipsys_log.exchange.row_files import read_rows
from ipsys_log.log.location import LogUrl
from ipsys_log.messages import Message, Tracks
from tests.batch.piece_works import PARAMETERS, UNTIL
from tests.batch.works import batch
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys
from tests.s3_server import put

# The import of the server takes seconds; s3fs closes its connections after the test.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

PAPER_LAB = ROOT / "sample_logs" / "paper_lab.mcap"


def test_results_of_objects_are_in_derived_logs(bucket: Any, tmp_path: Path) -> None:
    """The logs of a pattern keep their folders; a second call finds their results."""
    pytest.importorskip("distributed", reason="no Dask: pip install 'ipsys_log[batch]'")
    for month in ("01", "02"):
        put(bucket, f"2026-{month}/lab.mcap", PAPER_LAB.read_bytes())
    api.replay(PAPER_LAB, models=("rigid",), output=tmp_path / "alone.mcap")
    command = ("replay", "s3://logs/2026-*/lab.mcap", "--model", "rigid", "-o", "out", "--workers", 1)
    _, result, errors = batch(tmp_path, *command)
    assert result["states"] == {"computed": 2}, errors
    derived = [tmp_path / "out" / f"2026-{month}" / "lab.derived.mcap" for month in ("01", "02")]
    assert sorted(path for path in (tmp_path / "out").rglob("*") if path.is_file()) == derived
    assert [log.read_bytes() == (tmp_path / "alone.mcap").read_bytes() for log in derived] == [True, True]
    put(bucket, "2026-03/lab.mcap", b"no log")
    _, result, errors = batch(tmp_path, *command)
    assert result["states"] == {"up to date": 2, "failed": 1}, errors
    rows = {row["log"]: row for row in result["results"]}  # in the order in which they were finished
    failed = rows.pop("s3://logs/2026-03/lab.mcap")
    assert len(failed["text"].splitlines()) == 1
    assert sorted(row["derived"] for row in rows.values()) == [*map(str, derived)]
    assert [log.read_bytes() == (tmp_path / "alone.mcap").read_bytes() for log in derived] == [True, True]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the derived log of the small log of the paper, to be copied."""
    path = tmp_path_factory.mktemp("results") / "lab.derived.mcap"
    api.replay(PAPER_LAB, models=("rigid",), output=path)
    return path


@pytest.fixture
def derived(results: Path, tmp_path: Path) -> Path:
    (tmp_path / "out").mkdir()
    return Path(shutil.copy(results, tmp_path / "out"))


def test_verify_repeats_the_runs_of_a_derived_log(bucket: Any, derived: Path) -> None:
    url = LogUrl(put(bucket, "lab.mcap", PAPER_LAB.read_bytes()))
    result = verify_log(url, folder=derived.parent)
    compared = api.verify(PAPER_LAB, derived)
    assert (result.state, result.derived) == ("identical", str(derived))
    assert result.messages == sum(comparison.left for comparison in compared) > 0

    def move(message: Message) -> Message:
        payload = message.payload
        return (
            replace(message, payload=replace(payload, tracks=())) if isinstance(payload, Tracks) else message
        )

    rewrite(derived, move).replace(derived)
    result = verify_log(url, folder=derived.parent)
    assert (result.state, result.good) == ("different", False)
    assert "/runs/rigid/tracks" in result.text


def test_check_reads_a_derived_log_too(bucket: Any, derived: Path) -> None:
    url = LogUrl(put(bucket, "lab.mcap", PAPER_LAB.read_bytes()))
    assert check_log(url, derived.parent) == LogResult(str(url), "sound", derived=str(derived))
    derived.write_bytes(derived.read_bytes()[:-1000])
    result = check_log(url, derived.parent)
    assert (result.state, result.good) == ("broken", False)
    assert result.text.startswith("lab.derived.mcap: ")


def test_export_of_a_derived_log_follows_its_changes(bucket: Any, derived: Path, tmp_path: Path) -> None:
    url = LogUrl(put(bucket, "lab.mcap", PAPER_LAB.read_bytes()))
    target = tmp_path / "tables" / "lab.csv"

    def export() -> LogResult:
        options: dict[str, Any] = {"table": "tracks", "run": None, "robot": None, "format": "csv"}
        return export_log(url, target, derived=derived.parent, **options)

    assert export().state == "exported"
    with api.open(PAPER_LAB, derived) as log:
        log.export(tmp_path / "expected.csv")
    assert target.read_bytes() == (tmp_path / "expected.csv").read_bytes()
    later_s = time.time() + 1000
    os.utime(target, (later_s, later_s))
    assert export().state == "up to date"
    os.utime(derived, (later_s + 1000, later_s + 1000))
    assert export().state == "exported"


def test_derived_log_of_another_object_fails(bucket: Any, derived: Path, tmp_path: Path) -> None:
    url = LogUrl(put(bucket, "lab.mcap", (ROOT / "sample_logs" / "small_lab.mcap").read_bytes()))
    options = {"table": "tracks", "run": None, "robot": None, "format": "csv"}
    tasks = (
        BatchTask(verify_log, {"folder": derived.parent}),
        BatchTask(check_log, {"folder": derived.parent}),
        BatchTask(
            export_log, {"target": tmp_path / "tables" / "lab.csv", "derived": derived.parent, **options}
        ),
    )
    for task in tasks:
        result = perform(task, url)
        assert result.state == "failed"
        assert result.text.startswith(f"{derived}: has results of another log than {url}; move it")
    assert not (tmp_path / "tables").exists()


class OneAfterTheOther:
    """Workers that compute the pieces of a log in this process, as on another machine."""

    divides, first_only = True, False

    def __init__(self, change: Callable[[], object] = lambda: None) -> None:
        self.change = change

    def prepare(self, _plan: PiecePlan) -> None: ...

    def compute(self, plan: PiecePlan) -> Iterator[PieceResult]:
        for piece in plan.pieces:
            yield compute_alone(*pickle.loads(pickle.dumps((plan.run, piece, fingerprint()))))
            self.change()


def test_pieces_of_an_object_give_the_bytes_of_the_file(
    bucket: Any, lab_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pieces, "_MIN_FRAMES", 1)
    url = LogUrl(put(bucket, "lab.mcap", lab_log.read_bytes()))
    options = {"until": UNTIL, "parameters": PARAMETERS, "folder": tmp_path}
    result = perform(BatchTask(replay_log, {**options, "workers": OneAfterTheOther()}), url)
    assert result.state == "computed"
    api.replay(lab_log, output=tmp_path / "alone.mcap", until=UNTIL, parameters=PARAMETERS, jobs=1)
    assert (tmp_path / "lab.derived.mcap").read_bytes() == (tmp_path / "alone.mcap").read_bytes()


def test_object_that_changes_between_pieces_fails(
    bucket: Any, lab_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pieces, "_MIN_FRAMES", 1)
    url = LogUrl(put(bucket, "lab.mcap", lab_log.read_bytes()))
    workers = OneAfterTheOther(lambda: put(bucket, "lab.mcap", PAPER_LAB.read_bytes()))
    options = {"until": UNTIL, "parameters": PARAMETERS, "folder": tmp_path, "workers": workers}
    result = perform(BatchTask(replay_log, options), url)
    assert "changed while it was read" in result.text
    assert not list(tmp_path.glob("*.mcap"))


def test_catalogue_of_a_bucket_reads_only_changed_objects(bucket: Any, tmp_path: Path, ipsys: Ipsys) -> None:
    for name in ("a", "b", "c"):
        put(bucket, f"2026/{name}.mcap", PAPER_LAB.read_bytes())
    target = tmp_path / "logs.parquet"

    def update(*place: str) -> dict[str, Any]:
        done = ipsys("catalogue", *place, "-o", target, "--json")
        assert done.code == 0, done.err
        answer: dict[str, Any] = json.loads(done.out)
        return answer

    assert update("s3://logs/2026") == {"format": 2, "logs": 3, "read": 3, "removed": 0, "errors": {}}
    (row, *_) = read_rows(target)[1]
    assert (row["log"], row["bytes"], row["measurements"]) == ("a.mcap", PAPER_LAB.stat().st_size, 114)
    assert update("s3://logs/2026")["read"] == 0
    # Another content of the same length.
    put(bucket, "2026/b.mcap", bytes(PAPER_LAB.stat().st_size))
    bucket.Object("2026/c.mcap").delete()
    answer = update("s3://logs/2026/*.mcap")
    assert (answer["logs"], answer["read"], answer["removed"]) == (2, 1, 1)
    assert list(answer["errors"]) == ["b.mcap"]
