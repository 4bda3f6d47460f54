"""The stages and ``ipsys replay``: they derive channels from channels, and report the accuracy."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from ipsys_log.cli.console import console, print_outcomes, progress_bar, remarks, say
from ipsys_log.cli.options import (
    AsJson,
    Calibrations,
    Corners,
    Logs,
    Method,
    RigFile,
    cameras_of,
    load_calibrations,
    load_matching_rig,
    log_option,
)
from ipsys_log.cli.signals import say_kept

if TYPE_CHECKING:
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.accuracy import Accuracy
    from ipsys_log.runs.provenance import Outcome

__all__ = ["EVALUATE", "MORE", "add_commands", "build_command", "derive", "options_of"]

_Path = Optional[Path]  # noqa: UP045

_MODEL_HELP = (
    "Model: rigid, poly, ann, kriging, kriging-regression, rayplane, best, or a hybrid such as rigid+poly; "
    "repeat it for several."
)
# Every option of these commands: its type with its help, and its default.
OPTIONS: dict[str, tuple[Any, Any]] = {
    "logs": (Logs, inspect.Parameter.empty),
    "model": (
        Annotated[
            Optional[list[str]],  # noqa: UP045
            typer.Option("--model", metavar="NAME", help=_MODEL_HELP),
        ],
        None,
    ),
    "model_from": (
        Annotated[
            _Path,
            typer.Option("--model-from", metavar="LOG", help="Copy the model of this log, and apply it."),
        ],
        None,
    ),
    "train": (
        Annotated[str, typer.Option(metavar="LABEL", help="Fit on the measurements with this label.")],
        "train",
    ),
    "seed": (
        Annotated[int, typer.Option(min=0, metavar="N", help="Seed of random splits, folds and subsets.")],
        0,
    ),
    "rig": (RigFile, None),
    "calibration": (Calibrations, None),
    "corners": (Corners, None),
    "method": (Method, "perimeter"),
    "run": (
        Annotated[
            Optional[str],  # noqa: UP045
            typer.Option(
                "--run", metavar="NAME", help="Name of the new run, instead of edges, poly, poly_2 ..."
            ),
        ],
        None,
    ),
    "output": (
        Annotated[_Path, log_option(help="Write the results to a new log, not to the last LOG.")],
        None,
    ),
    "as_live": (
        Annotated[
            bool,
            typer.Option("--as-live", help="Exclude the frames that were skipped during the recording."),
        ],
        False,
    ),
    "skip_ambiguous": (
        Annotated[
            bool,
            typer.Option("--skip-ambiguous", help="Exclude a marker from frames that show its id twice."),
        ],
        False,
    ),
    "plot": (
        Annotated[
            _Path,
            typer.Option(metavar="FILE", help="Draw the floor and the errors: .png, .pdf, .svg or .jpg."),
        ],
        None,
    ),
    "details": (
        Annotated[
            bool,
            typer.Option(
                "--details",
                help="Print details, too: errors by camera, every outlier, models by number of points.",
            ),
        ],
        False,
    ),
    "plots": (
        Annotated[_Path, typer.Option(metavar="DIR", help="Write the paper's tables and figures, and more.")],
        None,
    ),
    "as_json": (AsJson, False),
}
_FRAMES = (
    "logs",
    "rig",
    "calibration",
    "corners",
    "method",
    "run",
    "output",
    "as_live",
    "skip_ambiguous",
    "as_json",
)
_DETECT = tuple(name for name in _FRAMES if name != "method")
_MODELS = tuple(name for name in OPTIONS if name not in ("plot", "plots", "details"))
EVALUATE = (*_MODELS, "plots")

MORE = "\n\nThe command runs missing stages first."
_COMMANDS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "replay": (
        "fuse",
        tuple(OPTIONS),
        "Run the missing stages from detect to fuse, append their results, and print the accuracy.",
    ),
    "detect": ("detect", _DETECT, "Detect the markers in the frames."),
    "camera-frame": (
        "camera-frame",
        _FRAMES,
        f"Compute the position of each marker in camera coordinates.{MORE}",
    ),
    "fit": ("fit", _MODELS, f"Fit models to the calibration points (default: poly).{MORE}"),
    "evaluate": (
        "evaluate",
        (*EVALUATE, "details"),
        "Evaluate models: their errors, the learning curve and outliers of the measurements.\n\n"
        "The errors are on held-out calibration points and by cross-validation. Without --model, the command "
        f"evaluates all models.{MORE}",
    ),
    "locate": ("locate", _MODELS, f"Apply a model: compute world positions from each camera.{MORE}"),
    "fuse": ("fuse", _MODELS, f"Combine the positions of all cameras into one pose per robot.{MORE}"),
}


def add_commands(app: typer.Typer) -> None:
    for name, (until, options, text) in _COMMANDS.items():
        app.command(name, help=text)(build_command(options_of(options), partial(_derive, until)))


def options_of(names: Sequence[str]) -> dict[str, tuple[Any, Any]]:
    """Return rows of the table of options."""
    return {name: OPTIONS[name] for name in names}


def build_command(options: Mapping[str, tuple[Any, Any]], work: Callable[..., None]) -> Callable[..., None]:
    """Return a function that has only these options, by name: type with help, and default."""

    def command(**given: Any) -> None:
        work(**given)

    keyword = inspect.Parameter.KEYWORD_ONLY
    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(key, keyword, default=value, annotation=kind)
            for key, (kind, value) in options.items()
        ]
    )
    command.__annotations__ = {key: kind for key, (kind, _) in options.items()}
    return command


def _options(logs: list[Path], **given: Any) -> dict[str, Any]:
    """Return the options of a command as those of :func:`ipsys_log.api.replay`."""
    from ipsys_log.rig.file import check_name

    rig, run = given.pop("rig"), given.pop("run")
    return {
        "models": given.pop("model", None) or (),
        "rig": load_matching_rig(rig, lambda: cameras_of(logs)),
        "calibrations": load_calibrations(given.pop("calibration", None), lambda: cameras_of(logs)),
        "run": check_name(run, "--run") if run else None,
        **given,
    }


@contextmanager
def derive(
    logs: list[Path], until: str, output: Path | None = None, kept: bool = True, **given: Any
) -> Iterator[tuple[Session, list[Outcome], list[Accuracy]]]:
    """Run the stages up to ``until``; yield the session with the results, the outcomes, and the accuracy.

    The texts do not name a log that is not ``kept``.
    """
    from ipsys_log import api
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.accuracy import read_accuracy

    options = _options(logs, **given)
    with say_kept(_kept_runs(logs, output)), progress_bar() as progress:
        replayed = api.replay(*logs, until=until, output=output, progress=progress, say=say, **options)
    outcomes = list(replayed.outcomes)
    # A new log exists only if there was something to write.
    written = [output] if output is not None and output.exists() else []
    with Session([*logs, *written]) as session:
        yield session, outcomes, read_accuracy(session, outcomes)
    _remark(outcomes, [*logs, *written][-1] if kept else None)


def _kept_runs(logs: list[Path], output: Path | None) -> Callable[[Sequence[str]], str]:
    """Return a function that names the runs that an interrupted command has added."""
    from ipsys_log.log.dataset import Session
    from ipsys_log.runs.provenance import complete_runs

    if output is not None:
        return lambda _: f"{output} was not written: a new log is written only when all stages are done"

    def complete() -> dict[str, list[str]]:
        stages: dict[str, list[str]] = {}
        with Session(logs) as session:
            for run in complete_runs(session):
                stages.setdefault(run.run, []).append(run.stage)
        return stages

    before = complete()

    def added(_: Sequence[str]) -> str:
        new = {run: [s for s in stages if s not in before.get(run, ())] for run, stages in complete().items()}
        named = "; ".join(f"{run} ({', '.join(stages)})" for run, stages in new.items() if stages)
        if not named:
            return f"{logs[-1]} is unchanged: no run was complete"
        return f"complete in {logs[-1]}: {named}. To continue, repeat the command"

    return added


def _derive(
    until: str,
    logs: list[Path],
    as_json: bool,
    plot: Path | None = None,
    plots: Path | None = None,
    details: bool = False,
    **given: Any,
) -> None:
    from ipsys_log.report.files import check_figure_file, check_folder

    if plot is not None:
        check_figure_file(plot, "--plot", logs)
    if plots is not None:
        check_folder(plots, "--plots")
    with derive(logs, until, **given) as (session, outcomes, accuracies):
        drawn = _draw(session, accuracies, plot, plots)
    if as_json:
        _print_json(outcomes, accuracies)
    else:
        _print(accuracies, details)
    for line in drawn:
        remarks.print(line)


def _draw(
    session: Session, accuracies: Sequence[Accuracy], plot: Path | None, plots: Path | None
) -> list[str]:
    """Draw the requested figures; return a line for each figure."""
    drawn = []
    if plot is not None:
        from ipsys_log.report.floor_figure import draw_session

        draw_session(session, accuracies, plot)
        drawn.append(f"{plot} drawn")
    if plots is not None:
        from ipsys_log.report.findings import gather_findings
        from ipsys_log.report.paper_figures import write_plots

        names = write_plots(gather_findings(session, accuracies), plots)
        drawn.append(f"{plots} has {', '.join(names)}")
    return drawn


def _print_json(outcomes: Sequence[Outcome], accuracies: Sequence[Accuracy]) -> None:
    from ipsys_log.report.accuracy import accuracy_json
    from ipsys_log.report.summary import answer_json

    stages = [{"stage": o.stage, "run": o.run, "new": o.fresh, "messages": o.messages} for o in outcomes]
    results = {**answer_json(accuracies), **accuracy_json(accuracies), "stages": stages}
    print(json.dumps(results, indent=2, allow_nan=False))  # noqa: T201


def _print(accuracies: Sequence[Accuracy], details: bool) -> None:
    """Print the answer first, then one table, and on request all numbers."""
    from ipsys_log.report.summary import answer_text, models_table
    from ipsys_log.report.tables import accuracy_tables

    parts = [answer_text(accuracies), models_table(accuracies)]
    for part in [*parts, *(accuracy_tables(accuracies) if details else [])]:
        if part is not None:
            console.print(part)
            console.print()
    if accuracies and not details:
        remarks.print("--details prints errors by camera, every outlier and models by number of points")


def _remark(outcomes: list[Outcome], target: Path | None) -> None:
    """Print the stages that were done, and the log with the results."""
    print_outcomes(outcomes)
    if target is None:
        return
    if any(outcome.fresh for outcome in outcomes):
        remarks.print(f"results are in {target}", markup=False)
    else:
        remarks.print("nothing to do: all results are up to date")
