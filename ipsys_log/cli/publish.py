"""Datasets for others: ``ipsys pack`` writes one, ``ipsys score`` repeats its scores."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import console, print_json, progress_bar, say
from ipsys_log.cli.options import AsJson, file_log_argument
from ipsys_log.cli.signals import say_kept
from ipsys_log.plain_text import shell_words


def add_commands(app: typer.Typer) -> None:
    app.command()(pack)
    app.command()(score)


def pack(
    logs: Annotated[
        list[Path] | None,
        file_log_argument(help="Logs, read as one session; they stay unchanged."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="The dataset to write: a folder, or a zip archive if the name ends in .zip.",
        ),
    ] = None,
    card: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The filled form of the dataset card."),
    ] = None,
    card_form: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Only write the empty form of the dataset card."),
    ] = None,
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Score this model; repeat it for several. Default: all that the logs allow.",
        ),
    ] = None,
    without_images: Annotated[
        bool,
        typer.Option("--without-images", help="Leave out the images, and keep the detected markers."),
    ] = False,
    blur: Annotated[
        bool,
        typer.Option(
            "--blur", help="Blur the images outside of the detected markers: a new recording, in grey."
        ),
    ] = False,
    every: Annotated[int, typer.Option(min=1, metavar="N", help="Keep each n-th frame of each camera.")] = 1,
) -> None:
    """Write logs as a dataset: the recorded channels, the rig, a card, checksums and the expected scores.

    The scores are the errors of all models, as ipsys evaluate computes them. ipsys score repeats them.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.publish.card import write_card_form
    from ipsys_log.publish.packing import pack as pack_logs
    from ipsys_log.report.pack_scores import pack_text

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
        typer.Option(
            metavar="MODEL",
            help="Repeat only this model, or score your own as FILE.py:CLASS; repeat it for several.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check a dataset, run the pipeline again in a temporary copy, and compare the scores with those stated.

    The exit code is 1 if a score differs by more than its tolerance. The dataset is not changed. A model of
    your own is a class with fit(points_m, world_m) and predict(points_m); only code that you name is run.
    """
    from ipsys_log import api
    from ipsys_log.report.pack_scores import score_answer, score_json, score_tables

    with say_kept(lambda _: f"{dataset} is unchanged"), progress_bar(lines_in_pipe=True) as progress:
        result = api.score(dataset, models=model or (), progress=progress, say=say)
    if as_json:
        print_json(score_json(result))
    else:
        console.print(score_answer(result))
        for table in score_tables(result):
            console.print()
            console.print(table)
    if result.as_stated is False:
        raise typer.Exit(1)
