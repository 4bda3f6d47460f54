"""Datasets at an address: the archive is downloaded with fsspec, and scored as a file."""

import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

import ipsys_log
from ipsys_log.errors import IpsysError


class Quiet(SimpleHTTPRequestHandler):
    """A server of files that prints nothing."""

    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture
def address(packed: Path) -> Iterator[str]:
    """Serve the packs on loopback."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(packed))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


@pytest.mark.filterwarnings("ignore")
def test_dataset_at_an_address_is_scored(address: str, temporary: Path) -> None:
    result = ipsys_log.score(f"{address}/dataset.zip", models=["rigid"])
    assert result.as_stated
    assert len(result.comparisons) == 4
    assert list(temporary.iterdir()) == []


@pytest.mark.filterwarnings("ignore")
def test_missing_dataset_at_an_address_is_one_line(address: str, temporary: Path) -> None:
    with pytest.raises(IpsysError) as error:
        ipsys_log.score(f"{address}/other.zip")
    assert str(error.value).startswith(f"{address}/other.zip: the download failed: ")
    assert len(str(error.value).splitlines()) == 1
    assert list(temporary.iterdir()) == []


def test_failed_download_has_a_reason() -> None:
    """Nothing listens on port 1."""
    with pytest.raises(IpsysError, match=r"the download failed: Cannot connect to host 127\.0\.0\.1:1"):
        ipsys_log.score("http://127.0.0.1:1/other.zip")


def test_download_larger_than_the_disk_ends(
    address: str, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces = iter([bytes(1000)] * 1000)
    monkeypatch.setattr("ipsys_log.tools.publish.opened_pack._download", lambda source: pieces)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: type("Usage", (), {"free": 10_000}))
    with pytest.raises(IpsysError, match=r"has more than 5.0 kB, half of the free space"):
        ipsys_log.score(f"{address}/dataset.zip")
    assert len([*pieces]) == 994
    assert list(temporary.iterdir()) == []
