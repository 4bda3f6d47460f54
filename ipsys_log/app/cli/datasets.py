"""Collections of logs: ``ipsys catalogue`` lists them, ``pack`` publishes them, ``score`` repeats scores."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from ipsys_log.app.cli.console import console, print_result, progress_bar, say
from ipsys_log.app.cli.options import AsJson, file_log_argument, setting, switch
from ipsys_log.app.cli.signals import say_kept
from ipsys_log.app.report.files import check_file, check_parquet_name
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogLocation, parse_location
from ipsys_log.plain_text import plain_text, shell_words

_MOST_LINES = 30


def catalogue(
    folder: Annotated[
        str,
        typer.Argument(
            metavar="FOLDER",
            help="The folder, or its URL; all logs below it are in the catalogue. A URL may have a pattern, "
            "such as s3://lab/2026-*/*.mcap.",
        ),
    ],
    output: Annotated[Path, setting("--output,-o", "FILE", "The catalogue: a Parquet file (.parquet).")],
    baseline: Annotated[
        str | None,
        setting(
            "--baseline",
            "LOG",
            "Also record the drift of the cameras since this log, by their reference markers.",
        ),
    ] = None,
    model_from: Annotated[
        str | None,
        setting("--model-from", "LOG", "The log with the model for the drift. Default: the baseline."),
    ] = None,
    derived: Annotated[
        Path | None,
        setting(
            "--derived",
            "FOLDER",
            "The folder of -o in ipsys batch replay, with the results of logs that cannot be appended "
            "to. They count with their log. Default: the working folder.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a table with a row for each log: cameras, times, runs, versions, errors of models, gaps, drift.

    The command reads only logs that are new or have changed since the last call. A log that cannot be read
    has a row with its error, and the command still succeeds. pandas and DuckDB read the file.

    Examples

        ipsys catalogue logs -o catalogue.parquet
        ipsys catalogue logs -o catalogue.parquet --baseline logs/first.mcap
    """
    from ipsys_log.api.catalogue import Baseline, update_catalogue

    check_installed("catalogue needs", "pyarrow")
    check_parquet_name(output, "-o")
    check_file(output, "-o", [])
    if derived is not None and not derived.is_dir():
        raise IpsysError(f"--derived {derived}: is not a folder; name the folder of the derived logs")
    if model_from is not None and baseline is None:
        raise IpsysError("--model-from: has an effect only with --baseline; give the log before all moves")
    since = None
    if baseline is not None:
        log = _log("--baseline", baseline)
        since = Baseline(log, log if model_from is None else _log("--model-from", model_from))
    place = parse_location(folder)
    with progress_bar(()) as progress:
        update = update_catalogue(
            place, output, since, derived, lambda done, total: progress("logs", done, total)
        )
    removed = f", {update.removed} removed" if update.removed else ""
    lines: list[str | Text] = [f"{output} written: {update.logs} logs, {update.read} read{removed}"]
    errors = [f"{log}: {text}" for log, text in update.errors.items()]
    lines += [Text(plain_text(line), "yellow") for line in errors[:_MOST_LINES]]
    if len(errors) > _MOST_LINES:
        lines.append(f"and {len(errors) - _MOST_LINES} more logs with errors: --json lists all")
    print_result(asdict(update), lines, as_json)


def _log(name: str, text: str) -> LogLocation:
    log = parse_location(text)
    if isinstance(log, Path) and not log.is_file():
        raise IpsysError(f"{name} {log}: is not a file; name a log")
    return log


def pack(
    logs: Annotated[
        list[Path] | None, file_log_argument(help="Logs, read as one session; they stay unchanged.")
    ] = None,
    output: Annotated[
        Path | None,
        setting(
            "--output,-o",
            "DATASET",
            "The dataset to write: a folder, or a zip archive if the name ends in .zip.",
        ),
    ] = None,
    card: Annotated[Path | None, setting("--card", "FILE", "The filled form of the dataset card.")] = None,
    card_form: Annotated[
        Path | None, setting("--card-form", "FILE", "Only write the empty form of the dataset card.")
    ] = None,
    model: Annotated[
        list[str] | None,
        setting(
            "--model", "NAME", "Score this model; repeat it for several. Default: all that the logs allow."
        ),
    ] = None,
    without_images: Annotated[
        bool, switch("--without-images", "Leave out the images, and keep the detected markers.")
    ] = False,
    blur: Annotated[
        bool, switch("--blur", "Blur the images outside of the detected markers: a new recording, in grey.")
    ] = False,
    every: Annotated[int, setting("--every", "N", "Keep each n-th frame of each camera.", min=1)] = 1,
) -> None:
    """Write logs as a dataset: the recorded channels, the rig, a card, checksums and the expected scores.

    The scores are the errors of all models, as ipsys evaluate computes them. ipsys score repeats them.

    Examples

        ipsys pack --card-form card.toml                   # write the empty form
        ipsys pack calibration.mcap -o dataset/ --card card.toml
        ipsys pack calibration.mcap -o small.zip --card card.toml --without-images
    """
    from ipsys_log.app.report.pack_scores import pack_text
    from ipsys_log.tools.publish.card import write_card_form
    from ipsys_log.tools.publish.packing import pack as pack_logs

    if card_form is not None:
        write_card_form(card_form)
        say(
            f"{card_form} written: fill it in, then: "
            f"ipsys pack LOG -o dataset --card {shell_words(card_form)}"
        )
        return
    if not logs or output is None:
        raise IpsysError("pack needs logs and a dataset: ipsys pack lab.mcap -o dataset --card card.toml")
    if card is None:
        raise IpsysError("pack needs --card FILE; to write an empty form: ipsys pack --card-form card.toml")
    with say_kept(lambda _: f"{output} was not written"), progress_bar(lines_in_pipe=True) as progress:
        result = pack_logs(
            logs,
            output,
            card,
            models=model or (),
            without_images=without_images,
            blur=blur,
            every=every,
            progress=progress,
            say=say,
        )
    console.print(pack_text(result))


def score(
    dataset: Annotated[
        str,
        typer.Argument(
            help="A folder or a .zip of ipsys pack, or the address of such a .zip.", metavar="DATASET"
        ),
    ],
    model: Annotated[
        list[str] | None,
        setting(
            "--model",
            "MODEL",
            "Repeat only this model, or score your own as FILE.py:CLASS; repeat it for several.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check a dataset, run the pipeline again in a temporary copy, and compare the scores with those stated.

    The exit code is 1 if a score differs by more than its tolerance. The dataset is not changed. A model of
    your own is a class with fit(points_m, world_m) and predict(points_m); only code that you name is run.

    Examples

        ipsys score dataset/                               # exit code 0 or 1
        ipsys score small.zip --model mine.py:Estimator    # your own model
    """
    from ipsys_log.api import python_api as api
    from ipsys_log.app.report.pack_scores import score_answer, score_json, score_tables

    with say_kept(lambda _: f"{dataset} is unchanged"), progress_bar(lines_in_pipe=True) as progress:
        result = api.score(dataset, models=model or (), progress=progress, say=say)
    tables = [part for table in score_tables(result) for part in ("", table)]
    print_result(score_json(result), (score_answer(result), *tables), as_json)
    if result.as_stated is False:
        raise typer.Exit(1)
