"""The stages and ``ipsys replay``: they derive channels from channels, and report the accuracy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import print_outcomes, print_result, progress_bar, say
from ipsys_log.app.cli.lab_inputs import cameras_of, load_calibrations, load_matching_rig
from ipsys_log.app.cli.options import (
    check_present,
    figure_option,
    flag,
    log_option,
    option,
    stage_option,
    with_options,
)
from ipsys_log.app.cli.signals import say_kept
from ipsys_log.app.report.files import figure_folder
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation, parse_location
from ipsys_log.stages import ENTRIES, STAGE_NAMES, parameters_until

if TYPE_CHECKING:
    from rich.console import RenderableType

    from ipsys_log.app.report.accuracy import Accuracy
    from ipsys_log.engine.provenance import Outcome
    from ipsys_log.engine.request import Request
    from ipsys_log.log.dataset import Session


# The options of every stage, and of the printed results.
_SHARED: dict[str, cli.Option] = {
    "logs": (cli.Logs, cli.REQUIRED),
    "rig": (cli.RigFile, None),
    "calibration": (cli.Calibrations, None),
    "run": option(
        str | None, "--run", "NAME", "Name of the new run, instead of edges, poly, poly_2 ..."
    ),
    "output": (
        Annotated[Path | None, log_option(help="Write the results to a new log, not to the last LOG.")], None,
    ),
    "jobs": option(
        int | None, "--jobs", "N",
        "Number of processes for long logs and several models (default: the number of cores). The results "
        "are the same with any number.",
        min=1,
    ),
    "as_json": (cli.AsJson, False),
}  # fmt: skip
_PRINTS: dict[str, cli.Option] = {
    "plot": (
        Annotated[
            list[Path] | None,
            figure_option("the floor and the errors", "the paper's tables and figures, and more"),
        ],
        None,
    ),
    "details": flag(
        "--details", "Print details, too: errors by camera, every outlier, models by number of points."
    ),
}
# The order of options in the help. Parameters that are not in it come after these.
_ORDER = (
    *("logs", "model", "model_from", "train", "seed", "rig", "calibration", "corners", "method"),
    *("run", "output", "as_live", "skip_ambiguous", "jobs"),
)

_UNTIL = option(
    str | None, "--until", "STAGE", f"Stop after this stage: {', '.join(STAGE_NAMES)}. Default: fuse."
)
_STAGE_LINES = "\n\n".join(f"{entry.name}: {entry.help}" for entry in ENTRIES)
_REPLAY = f"""
Run the missing stages of a log, append their results to it, and print the accuracy.

Without --model, the command continues the newest run, with its model and settings. If there is none, it fits
joint to a log with markers and their heights, and best to any other log; a line says why. These are all
stages in their order; smooth only runs with --until smooth:

{_STAGE_LINES}

Examples

    ipsys replay calibration.mcap                      # fits the best model
    ipsys replay calibration.mcap --model poly --plot floor.png
    ipsys replay monday.mcap --model-from calibration.mcap
    ipsys replay calibration.mcap --rig lab.toml       # with a corrected rig
    ipsys replay monday.mcap --until detect            # only the markers
"""
_EVALUATE = """
Evaluate models: their errors, the learning curve and outliers of the measurements.

The errors are on held-out calibration points and by cross-validation. Without --model, the command evaluates
all models; joint only if the log has images or markers.

The command runs missing stages first.

Examples

    ipsys evaluate calibration.mcap                    # all models
    ipsys evaluate calibration.mcap --details          # with details
    ipsys evaluate calibration.mcap --model poly --model best --plot figures
"""


def options_until(name: str | None) -> dict[str, cli.Option]:
    """Return the options of a stage, with the parameters of all stages up to it; None: of all stages."""
    options = dict(_SHARED)
    as_json = options.pop("as_json")
    for parameter in parameters_until(name):
        options[parameter.name] = stage_option(parameter)
    ordered = {name: options[name] for name in _ORDER if name in options}
    return {**ordered, **options, "as_json": as_json}


def _request(logs: Sequence[LogLocation], **given: Any) -> Request:
    """Return the options of a command as a request."""
    from ipsys_log.engine.request import Request

    rig, calibration, lenses = given.pop("rig"), given.pop("calibration", None), given.pop("lenses", None)
    options = replay_options(**given)
    return Request(
        models=tuple(options.pop("models")),
        rig=load_matching_rig(rig, lambda: cameras_of(logs)),
        lenses={**load_calibrations(calibration, lambda: cameras_of(logs)), **(lenses or {})},
        **options,
    )


def replay_options(**given: Any) -> dict[str, Any]:
    """Return the options of a command without rig and intrinsics as those of `python_api.replay`."""
    from ipsys_log.engine.request import Request
    from ipsys_log.messages.rig_file import check_name

    run, models = given.pop("run"), given.pop("model", None) or ()
    if given.get("model_from") is not None:
        given["model_from"] = parse_location(given["model_from"])
    # Parameters that every request has; those of an added stage arrive by name.
    known = {field.name for field in fields(Request)}
    further = {name: given.pop(name) for name in [*given] if name not in known}
    return {
        "models": models,
        "run": check_name(run, "--run") if run else None,
        "parameters": {name: str(value) for name, value in further.items() if value not in (None, False)},
        **given,
    }


@contextmanager
def derive(
    logs: Sequence[LogLocation],
    until: str | None,
    output: Path | None = None,
    kept: bool = True,
    again: str = "repeat the command",
    **given: Any,
) -> Iterator[tuple[Session, list[Outcome], list[Accuracy]]]:
    """Run the stages up to ``until``; yield the session with the results, the outcomes, and the accuracy.

    The texts do not name a log that is not ``kept``. ``again`` continues after an interrupt. ``lenses`` are
    intrinsics by camera, in addition to the files of ``calibration``.
    """
    check_present(logs)
    # Not ``ipsys_log.api.python_api``: its imports take longer than finding that all results are there.
    from ipsys_log.app.report.accuracy import read_accuracy
    from ipsys_log.engine.output import choose_target
    from ipsys_log.engine.workers import available_cores
    from ipsys_log.live_runs import pipeline
    from ipsys_log.log.dataset import Session
    from ipsys_log.log.known_contents import one_reading

    jobs = given.pop("jobs", None) or available_cores()
    with one_reading():
        logs, output = choose_target(logs, output)
        request = _request(logs, **given)
        with say_kept(_kept_runs(logs, output, again)), progress_bar(jobs=jobs) as progress:
            outcomes = pipeline.replay(logs, request, until, output, progress, say, jobs)
        # A new log exists only if there was something to write.
        written = [output] if output is not None and output.exists() else []
        with Session([*logs, *written]) as session:
            yield session, outcomes, read_accuracy(session, outcomes)
    _remark(outcomes, [*logs, *written][-1] if kept else None)


def _kept_runs(
    logs: Sequence[LogLocation], output: Path | None, again: str
) -> Callable[[Sequence[str]], str]:
    """Return a function that names the runs that an interrupted command has added."""
    from ipsys_log.engine.provenance import complete_runs
    from ipsys_log.log.dataset import Session

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
        return f"complete in {logs[-1]}: {named}. To continue, {again}"

    return added


def _replay(until: str | None, **given: Any) -> None:
    if until is not None and until not in STAGE_NAMES:
        raise IpsysError(f"--until {until}: is not a stage; use one of {', '.join(STAGE_NAMES)}")
    unread = {parameter.name: parameter for parameter in parameters_until(None)}
    for parameter in parameters_until(until):
        del unread[parameter.name]
    for name, parameter in unread.items():
        if given.pop(name) != parameter.default:
            raise IpsysError(f"--{name.replace('_', '-')}: has no effect on the stages up to {until}")
    _derive(until, **given)


def _derive(
    until: str | None,
    logs: Sequence[LogLocation],
    as_json: bool,
    plot: Sequence[Path] | None = None,
    details: bool = False,
    **given: Any,
) -> None:
    with derive(logs, until, **given) as (session, outcomes, accuracies):
        drawn = [_draw(session, accuracies, path) for path in plot or ()]
    print_result(_result(outcomes, accuracies), _parts(accuracies, details), as_json)
    if accuracies and not (details or as_json):
        say("--details prints errors by camera, every outlier and models by number of points")
    for line in drawn:
        say(line)


def _draw(session: Session, accuracies: Sequence[Accuracy], path: Path) -> str:
    """Draw a figure, or all figures into a folder; return a line about it."""
    if (folder := figure_folder(path)) is None:
        from ipsys_log.app.report.floor_figure import draw_session

        draw_session(session, accuracies, path)
        return f"{path} drawn"
    from ipsys_log.app.report.findings import gather_findings
    from ipsys_log.app.report.paper_figures import write_plots

    return f"{folder[0]} has {', '.join(write_plots(gather_findings(session, accuracies), *folder))}"


def _result(outcomes: Sequence[Outcome], accuracies: Sequence[Accuracy]) -> dict[str, Any]:
    from ipsys_log.app.report.accuracy import accuracy_json
    from ipsys_log.app.report.summary import answer_json

    stages = [{"stage": o.stage, "run": o.run, "new": o.fresh, "messages": o.messages} for o in outcomes]
    return {**answer_json(accuracies), **accuracy_json(accuracies), "stages": stages}


def _parts(accuracies: Sequence[Accuracy], details: bool) -> Iterator[RenderableType]:
    """Yield the answer first, then one table, and on request all numbers."""
    from ipsys_log.app.report.summary import answer_text
    from ipsys_log.app.report.tables import accuracy_tables, models_table, trajectory_table

    parts = [answer_text(accuracies), models_table(accuracies)]
    further = [*accuracy_tables(accuracies), trajectory_table(accuracies)] if details else []
    for part in [*parts, *further]:
        if part is not None:
            yield part
            yield ""


def _remark(outcomes: list[Outcome], target: LogLocation | None) -> None:
    """Print the stages that were done, and the log with the results."""
    print_outcomes(outcomes)
    if target is None:
        return
    if any(outcome.fresh for outcome in outcomes):
        say(f"results are in {target}")
    else:
        say("nothing to do: all results are up to date")


_options = options_until(None)
_json = _options.pop("as_json")
_options = {"logs": _options.pop("logs"), "until": _UNTIL, **_options, **_PRINTS, "as_json": _json}
replay = with_options(_options, "replay", _REPLAY)(_replay)
_options = {**options_until("evaluate"), **_PRINTS}
evaluate = with_options(_options, "evaluate", _EVALUATE)(partial(_derive, "evaluate"))
