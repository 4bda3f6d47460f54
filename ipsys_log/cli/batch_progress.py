"""The progress of a batch on a terminal: logs with their rate and failures, and pieces of long logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ipsys_log.cli.console import remarks

if TYPE_CHECKING:
    from rich.progress import TaskID

    from ipsys_log.batch.tasks import LogResult
    from ipsys_log.log.location import LogLocation

# A task can take minutes: the rate is that of the last half hour.
_RATE_PERIOD_S = 1800.0


@contextmanager
def batch_bar(
    count: int,
) -> Iterator[tuple[Callable[[LogResult], None], Callable[[LogLocation, int, int], None]]]:
    """Yield functions that show a result, and the pieces of a log, as bars with rate and remaining time."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    if not remarks.is_terminal:
        yield lambda result: None, lambda log, done, total: None
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}", justify="right"),
        TextColumn("{task.fields[failures]}", justify="right"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=remarks, transient=True, speed_estimate_period=_RATE_PERIOD_S) as bar:
        task, failures = bar.add_task("logs", total=count, rate="", failures="0 failed"), 0
        of_log: dict[str, TaskID] = {}

        def show(result: LogResult) -> None:
            nonlocal failures
            failures += not result.good
            speed = bar.tasks[0].speed
            rate = f"{60 * speed:,.1f} logs/min" if speed else ""
            bar.update(task, advance=1, rate=rate, failures=f"{failures} failed")
            if result.log in of_log:
                bar.remove_task(of_log.pop(result.log))

        def show_pieces(log: LogLocation, done: int, total: int) -> None:
            name = str(log)
            if name not in of_log:
                of_log[name] = bar.add_task(f"pieces of {log.name}", rate="", failures="")
            bar.update(of_log[name], completed=done, total=total)

        yield show, show_pieces
