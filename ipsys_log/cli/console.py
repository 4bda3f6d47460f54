"""How the commands speak: results on stdout, progress and remarks on stderr."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from ipsys_log.request import Progress

__all__ = ["console", "progress_bar", "remarks"]

console = Console(highlight=False, soft_wrap=True)
remarks = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar for each stage, while it works and only on a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description:<13}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=remarks, transient=True, disable=not remarks.is_terminal) as bar:
        bars: dict[str, int] = {}

        def show(stage: str, done: int, total: int | None) -> None:
            if stage not in bars or done == 0:
                bars[stage] = bar.add_task(stage, total=total)
            bar.update(bars[stage], completed=done)  # type: ignore[arg-type]

        yield show
