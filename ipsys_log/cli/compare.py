"""Comparison of runs and speed of live runs: ``ipsys verify``, ``ipsys diff``, ``ipsys latency``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from ipsys_log.cli.console import console, progress_bar, remarks
from ipsys_log.cli.options import AsJson, OneLog, OtherLog, ReadLogs, one_log_argument
from ipsys_log.cli.signals import writes_nothing

if TYPE_CHECKING:
    from ipsys_log.analysis.differences import Comparison

_Run = Optional[str]  # noqa: UP045


def add_commands(app: typer.Typer) -> None:
    app.command()(verify)
    app.command()(diff)
    app.command()(latency)


@writes_nothing
def verify(
    logs: ReadLogs,
    run: Annotated[_Run, typer.Option("--run", metavar="NAME", help="Use only this run.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compute every run of a log again from its inputs, and compare each channel byte for byte.

    Frames that live processing skipped are excluded. Runs that ipsys cut or ipsys merge has copied without
    their whole inputs are compared with the hashes of the copy; the command names them. The exit code is 1 if
    there is a difference."""
    from ipsys_log import api
    from ipsys_log.report.cameras import comparison_json, comparison_table, first_difference

    with progress_bar() as progress:
        comparisons = api.verify(
            *logs, run=run, progress=progress, say=lambda text: remarks.print(text, markup=False)
        )
    if as_json:
        print(json.dumps(comparison_json(comparisons), indent=2))  # noqa: T201
    else:
        console.print(comparison_table(comparisons, ("log", "again")))
        difference = first_difference(comparisons)
        console.print(
            _agreement(comparisons) if difference is None else difference,
            style="green" if difference is None else "red",
            markup=False,
        )
    _end(comparisons)


@writes_nothing
def diff(
    first: Annotated[OneLog, one_log_argument(metavar="FIRST", help="The first log, a file or a URL.")],
    second: Annotated[
        OtherLog,
        one_log_argument(
            metavar="SECOND", help="The second log. Without it, --run twice compares two runs of the first."
        ),
    ] = None,
    run: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--run",
            metavar="NAME",
            help="The run to compare. Give it twice to compare two runs.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare the runs of two logs, or two runs of one log, channel by channel, and print the differences.

    The exit code is 1 if there is a difference."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.report.cameras import comparison_json, comparison_table, first_difference
    from ipsys_log.runs.verify import diff as compare
    from ipsys_log.runs.verify import explain_diff

    names: list[str | None] = list(run) if run else [None]
    if len(names) > 2:
        raise IpsysError("--run: is given more than twice; name one run, or one for each side")
    if second is None and len(names) < 2:
        raise IpsysError(
            "there is nothing to compare with; name a second log, or give --run twice for two runs of one log"
        )
    sides = first, second or first, (names[0], names[-1])
    comparisons = compare(*sides)
    # If a distance could be measured, they have frames in common.
    comparable = all(comparison.equal for comparison in comparisons) or any(
        comparison.rms is not None for comparison in comparisons
    )
    why = None if comparable else explain_diff(*sides)
    if as_json:
        reason = {} if why is None else {"nothing_in_common": why}
        print(json.dumps({**comparison_json(comparisons), **reason}, indent=2))  # noqa: T201
    else:
        console.print(comparison_table(comparisons, ("first", "second")))
        difference = why or first_difference(comparisons)
        console.print(
            "no difference" if difference is None else difference,
            style="green" if difference is None else "red",
            markup=False,
        )
    _end(comparisons)


def latency(
    logs: ReadLogs,
    plot: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(metavar="FILE", help="Draw the processing steps: .png, .pdf, .svg or .jpg."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the latency of each step of a live recording, from the frame to its position."""
    from dataclasses import asdict

    from ipsys_log.analysis.latency import latency_percentiles, recorded_latencies, step_times_s
    from ipsys_log.report.cameras import latency_table
    from ipsys_log.report.files import check_figure_file

    if plot is not None:
        check_figure_file(plot, "--plot", logs)
    times_s = step_times_s(recorded_latencies(logs))
    steps = latency_percentiles(times_s)
    if plot is not None:
        from ipsys_log.report.latency_figure import draw_latency

        draw_latency(times_s, plot)
        remarks.print(f"{plot} drawn", markup=False)
    if as_json:
        print(json.dumps({step: asdict(times) for step, times in steps.items()}, indent=2))  # noqa: T201
    else:
        console.print(latency_table(steps))


def _agreement(found: Sequence[Comparison]) -> str:
    count = sum(comparison.repeated for comparison in found)
    if count == len(found):
        return "the replay is identical to the log"
    return (
        f"{len(found) - count} channels have the messages of the cut or the merge; the replay of "
        f"{count or 'no'} channels is identical to the log"
    )


def _end(found: Sequence[Comparison]) -> None:
    if not all(comparison.equal for comparison in found):
        raise typer.Exit(1)
