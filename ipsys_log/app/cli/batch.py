"""Commands for many logs on many workers: ``ipsys batch replay``, ``evaluate``, ``verify`` and others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import print_result, remarks, say
from ipsys_log.app.cli.options import check_present, flag, log_argument, option, with_options
from ipsys_log.app.cli.signals import say_kept
from ipsys_log.app.cli.stages import options_until, replay_options
from ipsys_log.app.report.files import check_file, check_parquet_name
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogLocation

if TYPE_CHECKING:
    from rich.progress import TaskID

    from ipsys_log.api.batch.tasks import BatchTask, LogResult
    from ipsys_log.api.batch.workers import WorkerSettings

_MORE = "\n\nA log that fails does not affect the others. The exit code is 1 if a log failed."
_KEPT = "complete results are kept; nothing else is changed"
_KEPT_BY_SCHEDULER = (
    "complete results are kept; the workers of the scheduler complete the logs that they have begun, and no "
    "others"
)
_REPEAT = " After a failure or an interrupt, repeat the command: it computes only what is missing."
# A task can take minutes: the rate is that of the last half hour.
_RATE_PERIOD_S = 1800.0

_DERIVED = (
    "The folder of -o in ipsys batch replay, with the results of logs that cannot be appended to. Each log "
    "is read together with its derived log. Default: the working folder."
)
_LOGS = Annotated[
    cli.LogList,
    log_argument(
        help="Logs, files or URLs, each one on its own. A folder, or a URL that ends with /, stands for all "
        "logs below it."
    ),
]
_OUTPUT = option(
    Path | None, "--output,-o", "FOLDER",
    "The folder for the results of logs that cannot be appended to: URLs and read-only files. Default: the "
    "working folder.",
)  # fmt: skip
# The options of the workers and of the result, which all commands of the group have.
_WORKERS: dict[str, cli.Option] = {
    "scheduler": option(
        str | None, "--scheduler", "ADDRESS",
        "Use the workers of this Dask scheduler, such as tls://head:8786. Access to a scheduler means code "
        "execution on its workers, so it must use certificates. Default: processes on this machine.",
    ),
    "workers": option(
        int | None, "--workers", "N", "Worker processes on this machine. Default: one for each core.", min=1
    ),
    "memory_limit": option(
        str | None, "--memory-limit", "SIZE",
        "Memory of each worker process, such as 2GB. Default: an equal share.",
    ),
    "tls_ca": option(Path | None, "--tls-ca", "FILE", "Certificate of the authority, for --scheduler."),
    "tls_cert": option(Path | None, "--tls-cert", "FILE", "Your certificate, for --scheduler."),
    "tls_key": option(Path | None, "--tls-key", "FILE", "The key of your certificate, for --scheduler."),
    "insecure": flag(
        "--insecure", "Permit a scheduler without certificates: each program that reaches it can run code."
    ),
    "table": option(
        Path | None, "--table", "FILE", "Write the results to a Parquet file: a row for each log."
    ),
    "as_json": (cli.AsJson, False),
}  # fmt: skip
_EXPORT: dict[str, cli.Option] = {
    "output": option(
        Path, "--output,-o", "FOLDER",
        "The folder for the files, named as the logs. They keep the folders of the logs below the folder or "
        "pattern that you name.",
        cli.REQUIRED,
    ),
    "format_": option(str, "--format", "NAME", "csv, parquet, tum, kitti, ros2, mp4 or coco.", "csv"),
    "channel": option(
        str, "--channel", "NAME",
        "The table to export: tracks, positions, markers, camera_points, measurements, events, latency or "
        "truth.",
        "tracks",
    ),
    "run": option(str | None, "--run", "NAME", "Export this run instead of the newest."),
    "robot": option(str | None, "--robot", "NAME", "Export only this robot."),
    "derived": option(Path | None, "--derived", "FOLDER", _DERIVED),
    "overwrite": flag("--overwrite", "Export all logs, also those with a newer file."),
}  # fmt: skip


def make_group(wrap: Callable[[Callable[..., None]], Callable[..., None]]) -> typer.Typer:
    """Return the group with its commands, each wrapped: the single commands on many logs."""
    group = typer.Typer(
        name="batch",
        add_completion=False,
        help="Run a command on many logs, with many processes or the workers of a Dask scheduler.",
        no_args_is_help=True,
    )

    def add(name: str, text: str, work: Callable[..., None], options: dict[str, cli.Option]) -> None:
        options = {"logs": (_LOGS, cli.REQUIRED), **options, **_WORKERS}
        group.command(name, help=text)(wrap(with_options(options, name, text)(work)))

    derived = option(Path | None, "--derived,-o", "FOLDER", _DERIVED)
    outdated = flag("--outdated", "Replay only logs that hold outdated runs.")
    run = option(str | None, "--run", "NAME", "Use only this run.")
    text = "Run the missing stages of each log, and append their results to it." + _MORE + _REPEAT
    add("replay", text, _replay, {**_stage_options(None), "output": _OUTPUT, "outdated": outdated})
    text = "Evaluate models on each log, and append the evaluations to it. The catalogue collects the errors."
    text += _MORE + _REPEAT
    add("evaluate", text, partial(_replay, "evaluate"), {**_stage_options("evaluate"), "output": _OUTPUT})
    text = "Compute every run of each log again, and compare it byte for byte." + _MORE
    add("verify", text, _verify, {"run": run, "derived": derived})
    add("check", "Read each log completely and check it." + _MORE, _check, {"derived": derived})
    text = (
        "Export each log to a file of its name in a folder, which keeps the folders of the logs."
        + _MORE
        + _REPEAT
    )
    add("export", text, _export, _EXPORT)
    return group


def _stage_options(until: str | None) -> dict[str, cli.Option]:
    left_out = ("logs", "output", "jobs", "as_json")
    return {name: option for name, option in options_until(until).items() if name not in left_out}


def _replay(until: str | None = None, outdated: bool = False, **given: Any) -> None:
    from ipsys_log.api.batch.log_work import replay_log
    from ipsys_log.api.batch.tasks import BatchTask

    options, batch = _divide(given)
    folder = _result_folder(options.pop("output"), "-o")
    work = {"until": until, "outdated": outdated, "folder": folder, **_replay_options(options)}
    _run(BatchTask(replay_log, work, divides=True), **batch)


def _result_folder(folder: Path | None, option: str) -> Path:
    """Return the folder for derived logs, as workers with other working folders name it."""
    if folder is not None and folder.exists() and not folder.is_dir():
        raise IpsysError(f"{option} {folder}: is not a folder; name a folder for the results")
    return (folder or Path()).absolute()


def _verify(run: str | None, derived: Path | None, **batch: Any) -> None:
    from ipsys_log.api.batch.log_work import verify_log
    from ipsys_log.api.batch.tasks import BatchTask

    _run(BatchTask(verify_log, {"run": run, "folder": _result_folder(derived, "--derived")}), **batch)


def _check(derived: Path | None, **batch: Any) -> None:
    from ipsys_log.api.batch.log_work import check_log
    from ipsys_log.api.batch.tasks import BatchTask

    _run(BatchTask(check_log, {"folder": _result_folder(derived, "--derived")}), **batch)


def _export(
    logs: list[LogLocation],
    output: Path,
    format_: str,
    channel: str,
    run: str | None,
    robot: str | None,
    derived: Path | None,
    overwrite: bool,
    **batch: Any,
) -> None:
    from ipsys_log.api.batch.log_work import export_log, plan_exports
    from ipsys_log.api.batch.tasks import BatchTask

    wishes: dict[str, Any] = {"table": channel, "run": run, "robot": robot, "format": format_}
    targets = {log: file.absolute() for log, file in plan_exports(logs, output, **wishes).items()}
    options = {"overwrite": overwrite, "derived": _result_folder(derived, "--derived"), **wishes}
    _run(BatchTask(export_log, options, targets=targets), logs=logs, paths=[*targets], **batch)


def _divide(given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the options of the work, and those of the batch."""
    of_batch = {"logs", *_WORKERS}
    return (
        {name: value for name, value in given.items() if name not in of_batch},
        {name: value for name, value in given.items() if name in of_batch},
    )


def _replay_options(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options as those of `python_api.replay`; rig and intrinsics are read once."""
    from ipsys_log.app.cli.lab_inputs import load_calibrations, split_calibration
    from ipsys_log.messages.rig_file import load_rig
    from ipsys_log.models.table import check_name

    for model in options["model"] or ():
        check_name(model)
    rig, calibration = options.pop("rig"), options.pop("calibration") or []
    for text in calibration:
        camera, place = split_calibration(text)
        if camera is None:
            raise IpsysError(f"--calibration {place}: has no camera name; in a batch, write camera=file.yaml")
    settings = replay_options(**options)
    if settings["model_from"] is not None:
        check_present([settings["model_from"]])
    return {
        "rig": None if rig is None else load_rig(rig),
        "calibrations": load_calibrations(calibration, tuple),
        **settings,
    }


def _run(
    task: BatchTask,
    logs: list[LogLocation],
    table: Path | None,
    as_json: bool,
    paths: list[LogLocation] | None = None,
    **settings: Any,
) -> None:
    """Do the work on each log, and print the results in the order of the logs.

    Parameters
    ----------
    logs : as the user named them. Each must exist; a link without a file in a folder only fails itself.
    paths : the logs of the folders and patterns in ``logs``; None: they are searched here.
    """
    from ipsys_log.api.batch.workers import WorkerSettings
    from ipsys_log.log.log_files import expand_folders

    check_installed("batch needs", "dask", "distributed", "bokeh", "cryptography")
    if table is not None:
        check_installed("--table needs", "pyarrow")
        check_parquet_name(table, "--table")
        check_file(table, "--table", logs)
    workers = WorkerSettings(**settings)
    paths = expand_folders(logs) if paths is None else paths
    check_present(logs)
    if workers.scheduler is not None:  # its workers have other working directories
        paths = [_absolute(path) for path in paths]
        task = replace(
            task,
            options={name: _absolute(value) for name, value in task.options.items()},
            targets={_absolute(path): target for path, target in task.targets.items()},
        )
    results = _collect(task, paths, workers)
    _print(results, table, as_json)
    if not all(result.good for result in results):
        raise typer.Exit(1)


def _absolute(value: Any) -> Any:
    return value.absolute() if isinstance(value, Path) else value


def _collect(task: BatchTask, paths: Sequence[LogLocation], settings: WorkerSettings) -> list[LogResult]:
    from ipsys_log.api.batch.execution import run_batch
    from ipsys_log.api.batch.workers import most_tasks, open_workers

    by_log: dict[str, LogResult] = {}
    kept = _KEPT if settings.scheduler is None else _KEPT_BY_SCHEDULER
    count = most_tasks(paths) if task.divides else len(paths)
    with say_kept(lambda _: kept), open_workers(settings, count) as workers:
        say(f"dashboard: {workers.dashboard}")
        with _progress_bars(len(paths)) as (show, show_pieces):
            for result in run_batch(workers, task, paths, show_pieces):
                by_log[result.log] = result
                show(result)
    return [by_log[str(path)] for path in paths]


def _print(results: Sequence[LogResult], table: Path | None, as_json: bool) -> None:
    from ipsys_log.app.report.batch import batch_json, batch_table, failure_lines, write_results

    failures = (Text(line, "red") for line in failure_lines(results))
    print_result(batch_json(results), (batch_table(results), *failures), as_json)
    for trace in {result.trace for result in results if result.trace}:
        say(trace)
    if table is not None:
        write_results(table, results)
        say(f"{table} written: a row for each log")


@contextmanager
def _progress_bars(
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
