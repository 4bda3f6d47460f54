"""Merge of the logs of several recorders: ``ipsys merge``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from ipsys_log.cli.console import console, progress_bar, remarks
from ipsys_log.cli.options import AsJson, LogList, NewLog, Overwrite, log_argument
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.log.location import LogLocation
    from ipsys_log.runs.merge import MergeResult
    from ipsys_log.runs.merge_plan import LogOffset


def add_commands(app: typer.Typer) -> None:
    app.command()(merge)


def merge(
    logs: Annotated[
        LogList,
        log_argument(help="The logs of the recorders, files or URLs. The clock of the first log counts."),
    ],
    output: NewLog,
    offset: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            metavar="NAME=SECONDS",
            help="Add these seconds to all times of a log, such as monday_b=0.012; repeat it for several.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Merge the logs of several recorders of one session, with different cameras, into a new log.

    Each recorder has its own clock. Without --offset, the command estimates the offset of a log from moving
    markers that its cameras and those of an earlier log saw. Run ipsys detect on both logs first. Rigs and
    intrinsics must not contradict each other. The new log has the record of the merge with all offsets.
    """
    from ipsys_log.runs.merge import merge as merge_logs
    from ipsys_log.runs.merge_offsets import choose_offsets
    from ipsys_log.runs.output import check_copy

    check_copy(logs, output, overwrite)
    with progress_bar() as progress:
        offsets = choose_offsets(logs, offset or (), progress)
        result = merge_logs(logs, output, offsets, overwrite, progress)
    if as_json:
        print(json.dumps(_as_json(output, result), indent=2))  # noqa: T201
        return
    _show(logs, offsets, result)
    from ipsys_log.units import format_bytes

    console.print(
        f"{output} written: {result.messages} messages, {format_bytes(output.stat().st_size)}", markup=False
    )
    remarks.print(f"next: ipsys replay {shell_words(output)}", markup=False)


def _show(logs: Sequence[LogLocation], offsets: Sequence[LogOffset], result: MergeResult) -> None:
    for path, offset, one in zip(logs[1:], offsets[1:], result.logs[1:], strict=True):
        sigma = "" if offset.sigma_s is None else f" (estimated, sigma {offset.sigma_s * 1e3:.2f} ms)"
        console.print(f"{path}: {offset.offset_ns / 1e9:+.6f} s are added to its times{sigma}", markup=False)
        for old, new in one.renamed_runs.items():
            remarks.print(f"run {old} of {path} is run {new}", markup=False)


def _as_json(output: Path, result: MergeResult) -> dict[str, Any]:
    return {
        "output": str(output),
        "messages": result.messages,
        "logs": [
            {
                "name": one.name,
                "offset_ns": one.offset_ns,
                "offset_sigma_s": one.offset_sigma_s,
                "renamed_runs": one.renamed_runs,
            }
            for one in result.logs
        ],
    }
