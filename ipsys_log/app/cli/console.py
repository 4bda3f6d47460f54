"""Output of the commands: results on stdout, progress and remarks on stderr."""

from __future__ import annotations

import json
import logging
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from time import monotonic
from typing import IO, TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from ipsys_log.app.report.rows import counted
from ipsys_log.plain_text import plain_text
from ipsys_log.units import format_duration

if TYPE_CHECKING:
    from ipsys_log.engine.provenance import Outcome
    from ipsys_log.engine.request import Progress

_DRAW_EVERY_S = 0.1
# A stage with more runs than this gets a count instead of a list.
_MANY_RUNS = 4
_LONGEST = 10_000
# A step with more messages than this prints more than one line in a pipe; its bar leaves some out.
_LONG_STEP = 100
# An evaluation takes so many times the fit of its model: 5 to 12 times in the small sample.
_EVALUATION_FITS = 8
# The duration of shorter work is not said.
_LONG_S = 10.0


class SafeConsole(Console):
    """A console that prints text literally: no markup, and no control characters."""

    def __init__(self, file: IO[str], *, stderr: bool = False) -> None:
        # On a terminal, lines break between words; in a file or a pipe, they do not break.
        super().__init__(
            stderr=stderr, highlight=False, markup=False, emoji=False, soft_wrap=not file.isatty()
        )

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text or a cell for measuring and printing; it may contain untrusted names."""
        return super().render_str(_plain(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable, including those of a `Text`."""
        for piece in super().render(renderable, options):
            yield piece if piece.control else Segment(_plain(piece.text), piece.style)


def _plain(text: str) -> str:
    return plain_text(text, keep="\n", longest=_LONGEST)


console = SafeConsole(sys.stdout)
remarks = SafeConsole(sys.stderr, stderr=True)


class _Remarks(logging.Handler):
    """A handler that prints the warnings of the package, each text once."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._printed: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if text not in self._printed:
            self._printed.add(text)
            remarks.print(text, style="yellow")


@contextmanager
def print_warnings() -> Iterator[None]:
    """Print warnings of the package on stderr, one line each."""
    logger, handler = logging.getLogger("ipsys_log"), _Remarks()
    logger.addHandler(handler)
    propagate, logger.propagate = logger.propagate, False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


def say_durations(show: Progress, jobs: int, *, of_models_only: bool) -> Progress:
    """Return a progress function that also says how long work of more than 10 s takes.

    It says this before the evaluation of several models, and after a tenth of any other step.
    """
    begun_s: dict[str, float] = {}
    said: set[str] = set()
    fits_s = 0.0

    def note(stage: str, done: int, total: int | None) -> None:
        nonlocal fits_s
        now_s = monotonic()
        if done == 0 or stage not in begun_s:
            begun_s[stage] = now_s
            said.discard(stage)
        took_s, left_s = now_s - begun_s[stage], 0.0
        if stage == "fits":
            fits_s = took_s
        if total and stage == "models" and done == 0:
            left_s = _EVALUATION_FITS * fits_s / min(jobs, total)
        elif total and 10 * done >= total and " " not in stage and not of_models_only:
            left_s = took_s * (total - done) / done
        if left_s > _LONG_S and stage not in said:
            said.add(stage)
            say(f"{stage}: about {format_duration(left_s)} left")
        show(stage, done, total)

    return note


@contextmanager
def progress_bar(
    frame_steps: Collection[str] | None = None, lines_in_pipe: bool = False, jobs: int = 1
) -> Iterator[Progress]:
    """Yield the progress function; it shows a bar for each working step on a terminal.

    The runs of a stage, such as ``fit rigid`` and ``fit poly``, share a bar.

    Parameters
    ----------
    frame_steps : names of the steps that count frames: their bars show a rate. Default: the causal stages.
    lines_in_pipe : print lines in a file or a pipe, as :func:`progress_lines`; otherwise only the duration
        of long work.
    jobs : number of processes that evaluate several models.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description:<13}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}", justify="right"),
        TimeRemainingColumn(),
    )
    if not remarks.is_terminal:
        lines = progress_lines() if lines_in_pipe else lambda stage, done, total: None
        yield say_durations(lines, jobs, of_models_only=False)
        return
    if frame_steps is None:
        from ipsys_log.engine.graph import STAGES

        frame_steps = {stage.name for stage in STAGES if stage.causal}
    with Progress(*columns, console=remarks, transient=True) as bar:
        bars: dict[str, TaskID] = {}
        steps: dict[str, str] = {}
        drawn_s = 0.0

        def show(stage: str, done: int, total: int | None) -> None:
            nonlocal drawn_s
            step, (stage, _, run) = stage, stage.partition(" ")
            if stage not in bars or (done == 0 and not run and bar.tasks[bars[stage]].completed):
                bars[stage] = bar.add_task(step, total=total, rate="")
            elif steps[stage] != step:
                bar.reset(bars[stage], total=total, description=step, rate="")
            steps[stage] = step
            # Drawing the bar takes longer than processing a message; but a short step has few calls.
            now_s, is_short = monotonic(), total is not None and total <= _LONG_STEP
            if now_s - drawn_s < _DRAW_EVERY_S and done != total and not is_short:
                return
            drawn_s = now_s
            speed = bar.tasks[bars[stage]].speed
            rate = f"{speed:,.0f} frames/s" if speed and stage in frame_steps else ""
            bar.update(bars[stage], completed=done, rate=rate)

        yield say_durations(show, jobs, of_models_only=True)  # the bars show the time of the others


def progress_lines() -> Progress:
    """Return a progress function that prints a line for the end of a step, and tenths of a long one."""
    before = "", 0  # the step, and its tenths

    def show(stage: str, done: int, total: int | None) -> None:
        nonlocal before
        tenths = 10 * done // total if total else 0
        known = before[1] if before[0] == stage and before[1] <= tenths else 0
        before = stage, tenths
        if total and tenths > known and (done == total or total > _LONG_STEP):
            say(f"{stage}: {done} of {total}")

    return show


def say(text: str) -> None:
    """Print a remark unchanged, separate from the results."""
    remarks.print(text)


def warn(text: str) -> None:
    """Print a remark that the user should not miss."""
    remarks.print(text, style="yellow")


# ``--json=1`` gives the keys of format 1 for one release.
OLD_JSON = "--json=1"


def print_json(value: Any) -> None:
    """Print a result for programs."""
    from ipsys_log.app.report.json_format import document, old_document

    result = old_document(value, sys.argv[1]) if OLD_JSON in sys.argv else document(value)
    print(json.dumps(result, indent=2, allow_nan=False))  # noqa: T201


def print_result(value: Any, parts: Iterable[object], as_json: bool, notes: Iterable[str] = ()) -> None:
    """Print a result for programs, or its tables and lines; then remarks on it."""
    if as_json:
        print_json(value)
    else:
        for part in parts:
            console.print(part)
    for note in notes:
        warn(note)


def print_outcomes(outcomes: Sequence[Outcome]) -> None:
    """Print the stages that were computed, were up to date, or were left out."""
    rest = _print_many(outcomes)
    width = max((len(outcome.run) for outcome in rest), default=0)
    for outcome in rest:
        state = counted(outcome.messages, "message") if outcome.fresh else "up to date"
        remarks.print(f"{outcome.stage:<13} run {outcome.run:<{width}} {state}")
        for remark in outcome.remarks:
            remarks.print(f"  {remark}", style="yellow")


def _print_many(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Print one line for many runs of a stage without remarks; return the other outcomes."""
    alike = Counter((outcome.stage, outcome.fresh) for outcome in outcomes if not outcome.remarks)
    many = {kind for kind, count in alike.items() if count > _MANY_RUNS}
    for stage, fresh in alike:
        if (stage, fresh) in many:
            remarks.print(f"{stage:<13} {alike[stage, fresh]} runs {'computed' if fresh else 'up to date'}")
    return [outcome for outcome in outcomes if outcome.remarks or (outcome.stage, outcome.fresh) not in many]
