"""Comparison of runs and speed of live runs: ``ipsys verify``, ``ipsys diff``, ``ipsys latency``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from ipsys_log.cli.console import console, progress_bar, remarks
from ipsys_log.cli.options import AsJson, Logs

if TYPE_CHECKING:
    from ipsys_log.analysis.differences import Comparison

__all__ = ["add_commands"]

_Run = Optional[str]  # noqa: UP045


def add_commands(app: typer.Typer) -> None:
    app.command()(verify)
    app.command()(diff)
    app.command()(latency)


def verify(
    logs: Logs,
    run: Annotated[_Run, typer.Option("--run", metavar="NAME", help="Only this run.")] = None,
    as_json: AsJson = False,
) -> None:
    """Make every run of a log again from what it read, and compare each channel byte for byte.

    Frames that were skipped live are passed over. Exits with code 1 if anything differs."""
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
            "a replay equals the log" if difference is None else difference,
            style="green" if difference is None else "red",
            markup=False,
        )
    _end(comparisons)


def diff(
    first: Annotated[Path, typer.Argument(help="A log.")],
    second: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Argument(help="The log to compare with; without it, --run twice names two runs of the first."),
    ] = None,
    run: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--run",
            metavar="NAME",
            help="The run of both logs; or twice: that of the first, that of the second.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare the runs of two logs, or two runs of one log, channel by channel, and print the differences.

    Exits with code 1 if anything differs."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.report.cameras import comparison_json, comparison_table, first_difference
    from ipsys_log.runs.verify import diff as compare
    from ipsys_log.runs.verify import explain_diff

    names: list[str | None] = list(run) if run else [None]
    if len(names) > 2:
        raise IpsysError("--run: name one run, or one of each log")
    if second is None and len(names) < 2:
        raise IpsysError("name a second log, or with --run twice two runs of one")
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
    logs: Logs,
    plot: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(metavar="FILE", help="Draw the steps: .png, .pdf, .svg or .jpg."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show how long each step took when a log was recorded live, from the frame to its position."""
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


def _end(found: Sequence[Comparison]) -> None:
    if not all(comparison.equal for comparison in found):
        raise typer.Exit(1)
