"""A log that cannot be read is not called broken: its content is unknown."""

from itertools import count
from pathlib import Path

import pytest

from ipsys_log.errors import UnreadError
from ipsys_log.log import remote_bytes
from ipsys_log.log.location import LogUrl
from ipsys_log.log.remote_bytes import RemoteBytes, RemoteRanges
from ipsys_log.log.remote_object import RemoteObject, open_object
from ipsys_log.tools.soundness.check import check_logs
from ipsys_log.tools.soundness.finding import BROKEN, READABLE, UNREAD, LogCheck
from tests.log.range_server import Store


def test_unreachable_url_is_unread(store: Store) -> None:
    url = LogUrl(f"{store.address}/none.mcap")
    [check] = check_logs([url])
    assert (check.state, [finding.text for finding in check.findings]) == (UNREAD, ["does not exist"])
    store.status = 503
    [check] = check_logs([url])
    assert check.state == UNREAD
    assert check.findings[0].text.startswith("cannot be read after 5 attempts: ")


@pytest.mark.slow
def test_lost_connection_is_no_damage(store: Store, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection is lost at each request of a check in turn, for a sound log and a damaged one."""
    for name in ("_HEAD", "_TAIL", "_FIRST_AHEAD", "_LONGEST_AHEAD", "_LONGEST_JOINED"):
        monkeypatch.setattr(remote_bytes, name, 4096)  # many requests
    monkeypatch.setattr(RemoteBytes, "open", staticmethod(open_with_small_cache))
    sound = log.read_bytes()
    damaged = sound[:60_000] + bytes(5_000) + sound[65_000:]
    for data, state in ((sound, READABLE), (damaged, BROKEN)):
        url = LogUrl(store.put(f"/{state}.mcap", data))
        needed = count_requests(monkeypatch, url, state)
        for number in range(0, needed, needed // 6):
            assert check_with_fault(monkeypatch, url, number).state == UNREAD, number


def open_with_small_cache(url: LogUrl) -> RemoteBytes:
    return RemoteBytes(url, RemoteRanges(open_object(url), capacity=16_384))


def count_requests(patch: pytest.MonkeyPatch, url: LogUrl, state: str) -> int:
    """Return the number of requests of a check that gives a state."""
    fetch, starts = RemoteObject.fetch, []

    def note(source: RemoteObject, start: int, end: int) -> bytes:
        starts.append(start)
        return fetch(source, start, end)

    with patch.context() as context:
        context.setattr(RemoteObject, "fetch", note)
        [check] = check_logs([url])
    assert check.state == state
    return len(starts)


def check_with_fault(patch: pytest.MonkeyPatch, url: LogUrl, number: int) -> LogCheck:
    """Check a log, and lose the connection for one request, after a number of requests."""
    fetch, requests = RemoteObject.fetch, count()

    def lose(source: RemoteObject, start: int, end: int) -> bytes:
        if next(requests) == number:
            raise UnreadError(f"{source.url} cannot be read: the connection is lost")
        return fetch(source, start, end)

    with patch.context() as context:
        context.setattr(RemoteObject, "fetch", lose)
        [check] = check_logs([url])
        return check


def test_missing_file_and_folder_are_unread(tmp_path: Path) -> None:
    assert [check.state for check in check_logs([tmp_path / "none.mcap", tmp_path])] == [UNREAD] * 2


def test_broken_log_is_worse_than_an_unread_one(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no log")
    assert LogCheck.worst(check_logs([tmp_path / "none.mcap", broken])) == BROKEN
