"""The answer of a batch: a row for each log, or for each state, and a line for each failure."""

import io
from pathlib import Path

from rich.console import Console

from ipsys_log.api.batch.tasks import LogResult
from ipsys_log.app.report.batch import batch_json, batch_table, failure_lines


def shown(results: list[LogResult]) -> list[str]:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(batch_table(results))
    return console.export_text().splitlines()


def logs(count: int, state: str = "computed", good: bool = True, text: str = "") -> list[LogResult]:
    runs = ("best",) if good else ()
    return [LogResult(f"{state}_{n:02}.mcap", state, good, text, runs, 10 * good) for n in range(count)]


def test_few_logs_have_a_row_each() -> None:
    lines = shown([*logs(19), *logs(1, "failed", good=False)])
    assert len([line for line in lines if ".mcap" in line]) == 20
    assert any(line.split() == ["computed_03.mcap", "computed", "best", "10"] for line in lines)
    assert any(line.split() == ["failed_00.mcap", "failed", "-", "0"] for line in lines)


def test_many_logs_are_counted_by_state() -> None:
    lines = shown([*logs(1, "failed", good=False), *logs(40), *logs(7, "up to date")])
    rows = [line.split() for line in lines]
    assert not [line for line in lines if ".mcap" in line]
    assert rows[-3:] == [["computed", "40", "400"], ["up", "to", "date", "7", "70"], ["failed", "1", "0"]]


def test_each_failure_is_a_line_up_to_a_limit() -> None:
    failures = logs(33, "failed", good=False, text="is\x1b[31m damaged\nat byte 9")
    lines = list(failure_lines([*logs(2), *failures]))
    assert len(lines) == 31
    assert lines[0].startswith("failed_00.mcap: is\\x1b[31m damaged")
    assert not any("\n" in line for line in lines)
    assert lines[-1] == "and 3 more: --json or --table FILE lists all"
    assert list(failure_lines(logs(1, "different", good=False))) == ["different_00.mcap: different"]


def test_json_has_the_states_and_leaves_out_what_is_empty() -> None:
    data = batch_json([*logs(2), *logs(1, "failed", good=False, text="no disk")])
    assert (data["logs"], data["states"]) == (3, {"computed": 2, "failed": 1})
    assert data["results"][-1] == {
        "log": str(Path("failed_00.mcap")),
        "state": "failed",
        "good": False,
        "text": "no disk",
        "messages": 0,
    }
    (divided,) = batch_json([LogResult("a.mcap", "computed", pieces=9)])["results"]
    assert divided["pieces"] == 9
