"""Logs in an S3 server on loopback: the same results as from a file, versions, and lists of many pages."""

from pathlib import Path
from typing import Any

import pytest

import ipsys_log
from ipsys_log.log import remote_object
from ipsys_log.log.location import parse_location
from ipsys_log.log.log_files import find_logs, states_below
from tests.conftest import ROOT, Ipsys
from tests.s3_server import put

GOLDEN = ROOT / "tests" / "golden" / "v0_1_0.mcap"
# The import of the server takes seconds; s3fs closes its connections after the test.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


def test_results_from_s3_are_those_of_the_file(
    bucket: Any, ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    local = tmp_path / "lab.mcap"
    local.write_bytes(GOLDEN.read_bytes())
    assert ipsys("evaluate", local, "--model", "rigid").code == 0
    url = put(bucket, "2026/lab.mcap", local.read_bytes())
    for words in (("info", "{}", "--json"), ("evaluate", "{}", "--model", "rigid", "--json")):
        one, other = (ipsys(*(word.format(log) for word in words)) for log in (url, local))
        assert one.code == 0, one.err
        assert one.out == other.out.replace(str(local), url)
    with ipsys_log.open(url) as remote, ipsys_log.open(local) as log:
        for name in ("markers", "camera_points", "measurements"):
            assert remote.table(name).equals(log.table(name))
    assert [path.name for path in tmp_path.iterdir()] == ["lab.mcap"]  # all results were in the log


def test_pattern_matches_more_objects_than_one_page_has(bucket: Any, ipsys: Ipsys) -> None:
    from moto.backends import get_backend

    keys = [f"2026-{number:04}/lab.mcap" for number in range(1100)]
    (store,) = get_backend("s3")["123456789012"].values()
    for key in (*keys, "2027-0001/lab.mcap"):  # without a request for each
        store.put_object("logs", key, b"")
    put(bucket, "2026-0001/other.mcap", b"")
    put(bucket, "2026-0001/deep/lab.mcap", b"")
    logs = find_logs(["s3://logs/2026-*/lab.mcap"])
    assert [str(log) for log in logs] == [f"s3://logs/{key}" for key in keys]
    done = ipsys("du", "s3://logs/2028-*/lab.mcap")
    assert done.code == 1
    assert done.err == (
        "ipsys: s3://logs/2028-*/lab.mcap: no object matches; check the pattern and the permission to list\n"
    )


def test_states_of_many_objects_come_with_their_list(bucket: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from moto.backends import get_backend

    (store,) = get_backend("s3")["123456789012"].values()
    for number in range(1100):
        store.put_object("logs", f"lab/{number:04}/a.mcap", b"x" * (number % 7))
    store.put_object("logs", "lab/0001/notes.txt", b"")
    with monkeypatch.context() as patch:  # a request for each object would fail
        patch.setattr(remote_object, "open_object", None)
        states = {name: state for name, _, state in states_below(parse_location("s3://logs/lab")) if state}
    assert [*states] == [f"{number:04}/a.mcap" for number in range(1100)]
    assert [state.size for state in states.values()] == [number % 7 for number in range(1100)]
    assert len({state.version.partition("ETag=")[2][:34] for state in states.values()}) == 7


def test_logs_of_a_pattern_are_read_as_one(bucket: Any) -> None:
    for key, name in (("a/paper.mcap", "paper_lab"), ("b/small.mcap", "small_lab")):
        put(bucket, key, (ROOT / "sample_logs" / f"{name}.mcap").read_bytes())
    with ipsys_log.open("s3://logs/[ab]/*.mcap") as log:
        assert [str(path) for path in log.paths] == ["s3://logs/a/paper.mcap", "s3://logs/b/small.mcap"]
        assert len(log.table("measurements")) == 114 + 96


@pytest.mark.parametrize(
    ("environment", "text"),
    [
        ({"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, "cannot be read after 2 attempts: "),
        ({}, "does not exist"),
    ],
)
def test_faults_of_s3_are_one_line(
    bucket: Any, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], text: str
) -> None:
    import s3fs

    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    done = ipsys("info", "s3://logs/x.mcap")
    assert done.code == 1
    assert done.err.startswith(f"ipsys: s3://logs/x.mcap {text}"), done.err
    assert len(done.err.splitlines()) == 1
