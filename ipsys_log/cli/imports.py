"""Data of others into a log: ``ipsys import imsel`` and ``ipsys import images``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import console, remarks
from ipsys_log.cli.options import Calibrations, NewLog, RigFile

__all__ = ["add_commands"]


def add_commands(app: typer.Typer) -> None:
    group = typer.Typer(help="Turn the data of others into a log.", no_args_is_help=True)
    group.command("imsel")(imsel)
    group.command("images")(images)
    app.add_typer(group, name="import")


def imsel(
    folder: Annotated[Path, typer.Argument(help="The authors' data, or a clone of their repository.")],
    output: NewLog,
) -> None:
    """The measurements behind the paper (Ou et al., Robotica 2023): .mat files and camera YAMLs."""
    from ipsys_log.formats.imsel import read_imsel
    from ipsys_log.output import write_log

    counts = write_log(output, read_imsel(folder))
    console.print(f"{output} written: {sum(counts.values())} messages on {len(counts)} channels")


def images(
    folder: Annotated[Path, typer.Argument(help="A folder with one sub-folder of pictures per camera.")],
    output: NewLog,
    rig: RigFile = None,
    calibration: Calibrations = None,
    rate: Annotated[float, typer.Option(help="Pictures per second.")] = 1.0,
) -> None:
    """A folder of pictures, one sub-folder per camera; the n-th of each belong together."""
    from ipsys_log.cli.options import load_calibrations
    from ipsys_log.output import write_log
    from ipsys_log.rig import load_rig
    from ipsys_log.sources.files import find_pictures, read_images

    pictures = find_pictures(folder)
    lenses = load_calibrations(calibration, lambda: pictures)
    write_log(output, read_images(pictures, load_rig(rig) if rig else None, lenses, rate))
    if len({len(paths) for paths in pictures.values()}) > 1:
        remarks.print("cameras have unequal numbers of pictures: the n-th of each are taken for one instant")
    counts = ", ".join(f"{len(paths)} of {camera}" for camera, paths in pictures.items())
    console.print(f"{output} written: pictures: {counts}")
