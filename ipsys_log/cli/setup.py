"""Begin: ``ipsys init`` and ``ipsys simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import console

__all__ = ["add_commands"]


def add_commands(app: typer.Typer) -> None:
    app.command()(init)
    app.command()(simulate)


def init(path: Annotated[Path, typer.Argument(help="The rig file to write.")] = Path("lab.toml")) -> None:
    """Write a commented rig file: markers, cameras, reference points, floor."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.rig import example_toml

    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(example_toml())
    except FileExistsError as error:
        raise IpsysError(f"{path}: exists already; edit it, or give another name") from error
    console.print(f"{path} written: edit it to describe your lab")


def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="The log to write.")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same bytes.")] = 0,
) -> None:
    """Render a lab with known truth: still stations with tape measurements, then a drive."""
