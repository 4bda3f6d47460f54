"""Compaction of logs: the dropped runs, and the provenance of the kept runs."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.engine.graph import version_parameters
from ipsys_log.engine.output import append_messages, write_log
from ipsys_log.engine.request import Request
from ipsys_log.engine.states import recorded_stages
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.live_runs.survey.from_log import exclude
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraPoints, ChannelRead, ChannelWritten, CompressedImage, Message, Run
from ipsys_log.messages.channels import MEASUREMENTS
from ipsys_log.tools.cut import compact, cut, superseded_runs
from ipsys_log.tools.cut_selection import CutOptions
from ipsys_log.tools.verify import verify
from tests.conftest import Ipsys
from tests.log.conftest import Row, stock_rows
from tests.shared_files import make_once


def run_of(row: Row) -> str | None:
    return row[0].split("/")[2] if row[0].startswith("/runs/") else None


def states(log: Path) -> dict[tuple[str, str], str]:
    with Session([log]) as session:
        return {(one.run.run, one.run.stage): one.state for one in recorded_stages(session)}


def superseded(log: Path) -> dict[str, str]:
    with Session([log]) as session:
        return {run.run: run.reason for run in superseded_runs(session)}


@pytest.fixture(scope="session")
def grown_log(detected_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated session with two rigid models, the first superseded, and an unfinished run."""

    def write(folder: Path) -> None:
        log = folder / "lab.mcap"
        shutil.copy(detected_log, log)
        replay([log], Request(models=("rigid",)), "fuse")
        with Session([log]) as session:
            name = session.payloads(session.topics(MEASUREMENTS))[0].id
            end_ns = session.end_ns
        exclude(log, [name], "the tape sagged")
        replay([log], Request(models=("rigid",)), "fuse")
        points = CameraPoints(end_ns, ())
        topic = "/runs/stopped/cameras/red/camera_points"
        append_messages(log, [Message(topic, end_ns, end_ns, points, "red")])

    return make_once(tmp_path_factory, "grown", write) / "lab.mcap"


def test_compaction_drops_only_the_superseded_runs(ipsys: Ipsys, grown_log: Path, tmp_path: Path) -> None:
    before, small = grown_log.read_bytes(), tmp_path / "small.mcap"
    assert superseded(grown_log) == {"rigid": "superseded by rigid_2", "stopped": "unfinished"}
    done = ipsys("compact", grown_log, "-o", small)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert lines[0].startswith("rigid is dropped: superseded by rigid_2; ")
    assert lines[1].startswith("stopped is dropped: unfinished; 1 message, about ")
    assert lines[3].startswith(f"{small} written: ")
    assert grown_log.read_bytes() == before
    dropped = superseded(grown_log)
    assert stock_rows(small) == [row for row in stock_rows(grown_log) if run_of(row) not in dropped]
    assert small.stat().st_size < len(before)
    # A second compaction has nothing to do.
    again = ipsys("compact", small, "-o", tmp_path / "smaller.mcap")
    assert (again.code, "no run is superseded" in again.out) == (0, True)
    assert sorted(tmp_path.iterdir()) == [small]


def test_kept_runs_verify_as_before(grown_log: Path, tmp_path: Path) -> None:
    """The records of the kept runs say the truth in the copy: states and repeated bytes are the same."""
    small = tmp_path / "small.mcap"
    compact(grown_log, small)
    dropped = superseded(grown_log)
    kept = {key: state for key, state in states(grown_log).items() if key[0] not in dropped}
    assert states(small) == kept
    assert set(kept.values()) == {"current"}

    def verified(log: Path, run: str) -> list[tuple[str, int, bool]]:
        comparisons = verify([log], run, lambda stage, done, total: None)
        return [(one.topic, one.left, one.equal) for one in comparisons]

    assert verified(small, "rigid_2") == verified(grown_log, "rigid_2")
    assert all(equal for _, _, equal in verified(small, "rigid_2"))
    outcomes = replay([small], Request(models=("rigid",)), "fuse")
    assert not any(one.fresh for one in outcomes)


def test_dry_run_lists_the_runs_and_writes_nothing(ipsys: Ipsys, grown_log: Path, tmp_path: Path) -> None:
    done = ipsys("compact", grown_log, "--dry-run", "--json", "-o", tmp_path / "small.mcap")
    assert done.code == 0, done.err
    assert list(tmp_path.iterdir()) == []
    found = json.loads(done.out)
    small = tmp_path / "small.mcap"
    real = json.loads(ipsys("compact", grown_log, "--json", "-o", small).out)
    assert found["dropped"] == real["dropped"]
    assert found["output"] is None
    # The prediction counts messages; the file also loses their indexes, and compresses other neighbours.
    predicted = sum(one["stored_bytes"] for one in found["dropped"])
    dropped = superseded(grown_log)
    rows = [row for row in stock_rows(grown_log) if run_of(row) in dropped]
    assert sum(one["messages"] for one in found["dropped"]) == len(rows)
    assert 0 < predicted <= sum(len(row[3]) + 31 for row in rows)
    assert real["output_bytes"] == small.stat().st_size < real["bytes"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [((), "-o is missing"), (("-o", "grown.mcap", "--overwrite"), "this is the log itself")],
    ids=["no_output", "itself"],
)
def test_wrong_output_is_refused(
    ipsys: Ipsys, grown_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...], text: str,
) -> None:  # fmt: skip
    log = Path(shutil.copy(grown_log, tmp_path / "grown.mcap"))
    monkeypatch.chdir(tmp_path)
    before = log.read_bytes()
    done = ipsys("compact", log, *arguments)
    assert (done.code, text in done.err) == (1, True)
    assert log.read_bytes() == before


def test_part_of_a_log_is_compacted_like_the_log(grown_log: Path, tmp_path: Path) -> None:
    part, small = tmp_path / "part.mcap", tmp_path / "small.mcap"
    cut([grown_log], part, CutOptions(start="5", end="20"))
    # The message of the unfinished run is outside of the part.
    assert superseded(part) == {"rigid": "superseded by rigid_2"}
    compact(part, small)
    comparisons = verify([small], None, lambda stage, done, total: None)
    assert all(one.equal for one in comparisons)
    before = states(part)
    assert states(small) == {key: before[key] for key in states(small)}


def test_run_of_other_robots_keeps_the_run_it_reads(ipsys: Ipsys, tmp_path: Path) -> None:
    """The tracks of poly are superseded, but the new tracks come from its positions."""
    log = tmp_path / "lab.mcap"
    write_log(
        log, graph([("poly", "locate", ()), ("poly", "fuse", ("poly",)), ("poly_2", "fuse", ("poly",))])
    )
    assert superseded(log) == {}


def test_result_of_older_software_supersedes_nothing(tmp_path: Path) -> None:
    """A newer run of an older version supersedes nothing; one of a newer version does."""
    log = tmp_path / "lab.mcap"
    with_versions = [
        replace(message, payload=replace(message.payload, parameters={"detect": version}))
        if isinstance(message.payload, Run)
        else message
        for version, name in (("99", "a"), ("98", "a_2"))
        for message in graph([(name, "detect", ())])
    ]
    write_log(log, with_versions)
    assert superseded(log) == {}
    reverse = [m for m in with_versions if "/a/" not in m.topic] + [
        m for m in with_versions if "/a/" in m.topic
    ]
    again = [
        replace(m, payload=replace(m.payload, number=2 if m.payload.run == "a" else 1))
        if isinstance(m.payload, Run)
        else m
        for m in reverse
    ]
    write_log(tmp_path / "reverse.mcap", again)
    assert superseded(tmp_path / "reverse.mcap") == {"a_2": "superseded by a"}


Step = tuple[str, str, tuple[str, ...]]  # run, stage, runs that it reads


def topic_of(run: str, stage: str) -> str:
    return f"/runs/{run}/{stage.replace('-', '_')}"


def graph(steps: list[Step], unfinished: frozenset[int] = frozenset()) -> Iterator[Message]:
    """Yield the messages of a log with these runs; an unfinished stage has written half of its messages.

    A stage reads the newest channel of each run that it names.
    """
    from ipsys_log.log.codec import encode
    from ipsys_log.log.hashing import ChannelHash

    for number in range(3):
        image = CompressedImage(number, "red", bytes([number]) * 400, "jpeg")
        yield Message("/cameras/red/image", 10 + number, number, image, "red")
    known: dict[str, ChannelRead] = {}
    for number, (run, stage, reads) in enumerate(steps):
        topic, state = topic_of(run, stage), ChannelHash()
        for count in range(2):
            time_ns = 100 + 10 * number + count
            payload = CameraPoints(time_ns, ())
            state.add(time_ns, time_ns, encode(payload))
            yield Message(topic, time_ns, time_ns, payload, "red")
        inputs = tuple(known[name] for name in reads if name in known)
        known[run] = ChannelRead(topic, 2, state.digest.hex())
        written = (ChannelWritten(topic, 4 if number in unfinished else 2),)
        record = Run(
            time_ns,
            run,
            stage,
            version_parameters(stage),
            input_runs=reads,
            inputs=inputs,
            outputs=written,
            number=number + 1,
        )
        yield Message(f"/runs/{run}/record", time_ns + 1, time_ns, record)


@settings(max_examples=60)
@given(drawn=st.data())
def test_random_graphs_keep_the_newest_and_their_inputs(
    drawn: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A run of one stage is dropped if and only if the rule says so; the oracle reads the drawn table."""
    names = [f"{base}{number}" for base in ("a", "b") for number in ("", "_2", "_3")]
    order = drawn.draw(st.permutations(names))
    steps: list[Step] = []
    for name in order[: drawn.draw(st.integers(1, len(order)))]:
        earlier = [run for run, _, _ in steps]
        reads = drawn.draw(st.sets(st.sampled_from(earlier), max_size=2)) if earlier else set()
        stage = drawn.draw(st.sampled_from(("detect", "fuse")))
        steps.append((name, stage, tuple(sorted(reads))))
    unfinished = frozenset(n for n in range(len(steps)) if drawn.draw(st.booleans()))
    folder = tmp_path_factory.mktemp("graphs")
    log, small = folder / "log.mcap", folder / "small.mcap"
    write_log(log, graph(steps, unfinished))
    before = stock_rows(log)
    expected = _dropped(steps, unfinished)
    assert superseded(log).keys() == expected
    compact(log, small)
    assert stock_rows(small) == [row for row in before if run_of(row) not in expected]
    shutil.rmtree(folder)


def _dropped(steps: list[Step], unfinished: frozenset[int]) -> set[str]:
    branch: dict[str, object] = {}
    for run, stage, reads in steps:
        branch[run] = (run[0], stage, frozenset(branch[name] for name in reads))
    finished = [run for n, (run, _, _) in enumerate(steps) if n not in unfinished]
    newest = {branch[run]: run for run in finished}
    kept = waiting = set(newest.values())
    reads_of = {run: set(reads) for run, _, reads in steps}
    while waiting:
        waiting = set().union(*(reads_of[run] for run in waiting)) - kept
        kept |= waiting
    return {run for run, _, _ in steps} - kept
