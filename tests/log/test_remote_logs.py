"""Logs at URLs: the same results as from a file, and one clear line for each fault of a server."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import ipsys_log
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from tests.conftest import ROOT, Ipsys
from tests.log.range_server import Store

PAPER_LAB, SMALL_LAB = (ROOT / "sample_logs" / f"{name}_lab.mcap" for name in ("paper", "small"))
GOLDEN = ROOT / "tests" / "golden" / "v0_1_0.mcap"
# aiohttp closes its connections after the test.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture
def lab_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the log of the paper, in the current folder."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copy(PAPER_LAB, tmp_path / "lab.mcap"))


def test_info_at_a_url_is_that_of_the_file(store: Store, lab_copy: Path, ipsys: Ipsys) -> None:
    url = store.put("/a/lab.mcap", GOLDEN.read_bytes())
    remote, local = ipsys("info", url, "--json"), ipsys("info", GOLDEN, "--json")
    assert (remote.code, remote.err) == (0, "")
    assert remote.out == local.out.replace(str(GOLDEN), url)


def encoded(log: ipsys_log.Log, *channels: str) -> list[tuple[str, int, bytes]]:
    """Return the messages of recorded channels with their encoded payloads."""
    messages = (message for channel in channels for message in log.messages(channel))
    return [(message.topic, message.log_time_ns, encode(message.payload)) for message in messages]


def test_messages_survive_dropped_connections(store: Store) -> None:
    url = store.put("/lab.mcap", SMALL_LAB.read_bytes())
    store.drop_every = 2
    with ipsys_log.open(url) as remote, ipsys_log.open(SMALL_LAB) as local:
        assert encoded(remote, "images", "truth") == encoded(local, "images", "truth")
        assert remote.table("measurements").equals(local.table("measurements"))
    assert len(store.requests) > len(set(store.requests))


@pytest.mark.parametrize("with_etag", [True, False])
def test_object_changed_while_it_is_read_is_noticed(store: Store, with_etag: bool) -> None:
    store.with_etag = with_etag
    data = GOLDEN.read_bytes()
    url = store.put("/lab.mcap", data)
    with ipsys_log.open(url) as log:
        store.put("/lab.mcap", data[:-500_000] + bytes(500_000))
        with pytest.raises(IpsysError, match=rf"^{url} changed while it was read: run the command again$"):
            encoded(log, "markers")


def test_log_that_is_opened_again_has_its_new_content(store: Store) -> None:
    with ipsys_log.open(store.put("/lab.mcap", PAPER_LAB.read_bytes())) as log:
        before = log.channels
    with ipsys_log.open(store.put("/lab.mcap", GOLDEN.read_bytes())) as log, ipsys_log.open(GOLDEN) as local:
        assert log.channels == local.channels != before


def faults(store: Store) -> Iterator[tuple[str, str]]:
    """Yield URLs that cannot be read, and the error of each."""
    store.put("/lab.mcap", PAPER_LAB.read_bytes())
    yield f"{store.address}/x.mcap", " does not exist"
    yield f"{store.address}/x*.mcap", ": no object matches; check the pattern and the permission to list"
    yield "foo://lab/x.mcap", ": the protocol foo:// is not known; use a path, or a URL such as"
    yield "gs://lab/x.mcap", ": logs at gs:// need another package: pip install gcsfs"
    store.status = 403
    yield f"{store.address}/lab.mcap", " cannot be read: the store denies access; check the credentials"
    store.status = 503
    yield f"{store.address}/lab.mcap", " cannot be read after 5 attempts: 503"
    store.status, store.drop_every = 0, 1
    yield f"{store.address}/lab.mcap", " cannot be read after 5 attempts: "
    store.drop_every, store.with_ranges = 0, False
    yield store.put("/large.mcap", GOLDEN.read_bytes()), ": the server ignores byte ranges: download"
    store.with_ranges = True
    yield f"{store.put('/page.mcap', b'<html>' * 30_000)}", " is not an MCAP file"
    yield store.put("/empty.mcap", b""), " is empty: it has no messages"
    text = (
        " has no end: its recorder was killed, or the file was cut off. Its messages can be saved. Download"
    )
    yield store.put("/cut.mcap", GOLDEN.read_bytes()[:50_000]), text


def test_faults_of_a_server_are_one_line(store: Store, ipsys: Ipsys) -> None:
    for url, text in faults(store):
        done = ipsys("info", url)
        assert done.code == 1, url
        assert done.err.startswith(f"ipsys: {url}{text}"), done.err
        assert len(done.err.splitlines()) == 1


def test_password_and_query_are_in_no_output(store: Store, ipsys: Ipsys) -> None:
    store.put("/lab.mcap", PAPER_LAB.read_bytes())
    host = store.address.removeprefix("http://")
    for name, code in (("lab.mcap", 0), ("x.mcap", 1)):
        done = ipsys("info", f"http://ada:secret@{host}/{name}?signature=hidden", "--json")
        assert done.code == code, done.err
        assert f"http://ada:***@{host}/{name}" in done.out + done.err
        assert "secret" not in done.out + done.err
        assert "hidden" not in done.out + done.err


# Two evaluations.
@pytest.mark.slow
def test_results_of_a_url_come_into_a_derived_log(
    store: Store, lab_copy: Path, ipsys: Ipsys, tmp_path: Path
) -> None:
    url = store.put("/a/lab.mcap", lab_copy.read_bytes())
    lab_copy.unlink()
    words = ("evaluate", url, "--model", "rigid", "--json")
    first = ipsys(*words)
    assert first.code == 0, first.err
    derived = tmp_path / "lab.derived.mcap"
    assert [path.name for path in tmp_path.iterdir()] == [derived.name]
    written = derived.read_bytes()
    second = ipsys(*words)
    answers = [json.loads(done.out) for done in (first, second)]
    assert [stage["new"] for answer in answers for stage in answer.pop("stages")] == [True] * 3 + [False] * 3
    assert answers[0] == answers[1]
    assert derived.read_bytes() == written
    with ipsys_log.open(url, derived) as log:
        states = {row[0]: row[2] for row in log.runs}  # run, stage, state
    assert states["rigid"] == "current"
    store.put("/a/lab.mcap", SMALL_LAB.read_bytes())
    other = ipsys(*words)
    assert other.code == 1
    assert "lab.derived.mcap: has results of another log than" in other.err


# Two evaluations.
@pytest.mark.slow
def test_evaluation_of_a_url_is_that_of_the_file(store: Store, lab_copy: Path, ipsys: Ipsys) -> None:
    url = store.put("/a/lab.mcap", lab_copy.read_bytes())
    remote = ipsys("evaluate", url, "--model", "rigid", "--json", "-o", "results.mcap")
    local = ipsys("evaluate", lab_copy, "--model", "rigid", "--json")
    assert remote.code == 0, remote.err
    assert remote.out == local.out
    with ipsys_log.open(url, "results.mcap") as one, ipsys_log.open(lab_copy) as other:
        assert encoded(one, "evaluation", "model") == encoded(other, "evaluation", "model")
