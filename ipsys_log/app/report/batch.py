"""The result of a batch: a table and lines for the terminal, plain data, and a Parquet file."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.text import Text

from ipsys_log.api.batch.tasks import LogResult
from ipsys_log.app.report.rows import Rows, counted
from ipsys_log.exchange.row_files import write_rows
from ipsys_log.plain_text import plain_text

# A longer list is counted by state.
_MOST_LISTED = 20
_MOST_LINES = 30


def batch_table(results: Sequence[LogResult]) -> Rows:
    """Return a table with a row for each log; for many logs, with a row for each state."""
    title = counted(len(results), "log")
    if len(results) > _MOST_LISTED:
        messages: Counter[str] = Counter()
        for result in results:
            messages[result.state] += result.messages
        counts = Counter(result.state for result in results).most_common()
        cells = [[state, str(count), str(messages[state])] for state, count in counts]
        return Rows(title, ("state", ">logs", ">messages"), cells)
    rows = []
    for result in results:
        texts = (result.log, result.state, ", ".join(result.runs) or "-", str(result.messages))
        rows.append([Text(plain_text(text), style="" if result.good else "red") for text in texts])
    return Rows(title, ("log", "state", "runs", ">messages"), rows)


def failure_lines(results: Sequence[LogResult]) -> Iterator[str]:
    """Yield a line for each log that the user must look at: its path and the reason."""
    failures = [result for result in results if not result.good]
    for result in failures[:_MOST_LINES]:
        yield plain_text(f"{result.log}: {result.text or result.state}")
    if len(failures) > _MOST_LINES:
        yield f"and {len(failures) - _MOST_LINES} more: --json or --table FILE lists all"


def batch_json(results: Sequence[LogResult]) -> dict[str, Any]:
    """Return the results as plain data: the number of logs by state, and a row for each log."""
    return {
        "logs": len(results),
        "states": dict(Counter(result.state for result in results).most_common()),
        "results": [
            {key: value for key, value in asdict(result).items() if value not in ("", (), None)}
            for result in results
        ],
    }


def write_results(path: Path, results: Sequence[LogResult]) -> None:
    """Write a Parquet file with a row for each log."""
    columns = {
        "log": "string",
        "state": "string",
        "good": "bool",
        "text": "string",
        "runs": "list<string>",
        "messages": "int64",
        "trace": "string",
        "pieces": "int64",
        "derived": "string",
    }
    rows = ({name: None if value == "" else value for name, value in asdict(one).items()} for one in results)
    write_rows(path, rows, columns)
