"""A listing of 10,000 objects of an S3 server on loopback: the requests of a pattern and of the catalogue."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.api import catalogue
from ipsys_log.api.catalogue import Baseline, CatalogueUpdate, update_catalogue
from ipsys_log.log.location import LogLocation, parse_location
from ipsys_log.log.log_files import find_logs

# The import of the server takes seconds; s3fs closes its connections after the test.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

OBJECTS, PAGE, FEW = 10_000, 1_000, 3
NAMES = [f"{number // 100:03}/{number:05}.mcap" for number in range(OBJECTS)]


@pytest.fixture
def store(bucket: Any) -> Iterator[Any]:
    """Fill the bucket at the backend of the server, without a request for each object."""
    from moto.backends import get_backend

    (store,) = get_backend("s3")["123456789012"].values()
    for name in NAMES:
        store.put_object("logs", f"lab/{name}", b"")
    yield store
    store.buckets["logs"].keys.clear()


class Requests(logging.Handler):
    """The requests in the log of the server."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@contextmanager
def counted() -> Iterator[list[str]]:
    """Yield the requests that the server answers meanwhile."""
    logger, requests = logging.getLogger("werkzeug"), Requests()
    level = logger.level
    logger.addHandler(requests)
    logger.setLevel(logging.INFO)
    try:
        yield requests.lines
    finally:
        logger.setLevel(level)
        logger.removeHandler(requests)


def test_requests_of_many_objects_are_those_of_pages(
    store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with counted() as requests:
        logs = find_logs(["s3://logs/lab/*/*5.mcap"])
    assert [str(log) for log in logs] == [f"s3://logs/lab/{name}" for name in NAMES[5::10]]
    assert OBJECTS // PAGE <= len(requests) <= OBJECTS // PAGE + FEW, requests

    def update() -> tuple[CatalogueUpdate, int]:
        with counted() as requests:
            done = update_catalogue(parse_location("s3://logs/lab"), tmp_path / "logs.parquet")
        return done, len(requests)

    with monkeypatch.context() as patch:  # reading 10,000 objects would take minutes
        patch.setattr(catalogue, "read_row", row_without_reading)
        first, count = update()
    assert (first.logs, first.read) == (OBJECTS, OBJECTS)
    assert count <= OBJECTS // PAGE + FEW
    second, count = update()
    assert (second.logs, second.read, second.removed) == (OBJECTS, 0, 0)
    assert count <= OBJECTS // PAGE + FEW
    store.put_object("logs", f"lab/{NAMES[7]}", b"no log")
    third, count = update()
    assert (third.read, [*third.errors]) == (1, [NAMES[7]])
    assert count <= OBJECTS // PAGE + 2 * FEW


def row_without_reading(
    path: LogLocation, name: str, columns: dict[str, Any], baseline: Baseline | None, derived: Path | None
) -> dict[str, Any]:
    return {"log": name, **columns}
