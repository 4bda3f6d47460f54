"""Begin: ``ipsys init`` and ``ipsys simulate``."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ipsys_log.cli.console import console, progress_bar
from ipsys_log.cli.options import NewLog

if TYPE_CHECKING:
    from ipsys_log.messages import Message

__all__ = ["add_commands"]

# The settings of the simulated lab that have an option: type, help. Their defaults are the library's,
# which is not imported just to print a help.
SETTINGS: dict[str, tuple[type, str]] = {
    "seed": (int, "The same seed gives the same bytes."),
    "width": (int, "Of a frame, in px; the lens scales with it."),
    "height": (int, "Of a frame, in px."),
    "markers": (int, "How many lie or drive on the floor at once."),
    "stations": (int, "About how many measured places each camera sees."),
    "frames_per_station": (int, "Frames of each camera while the markers lie still."),
    "rate_hz": (float, "Frames per second."),
    "drive_s": (float, "How long the robots drive after the stations, in s."),
    "drive_speed_m_s": (float, "How fast, in m/s."),
    "psf_sigma_px": (float, "Blur of the optics: sigma of the point-spread, in px."),
    "black": (float, "Grey level of a marker's black, 0 to 255."),
    "white": (float, "Grey level of a marker's white."),
    "noise_sigma": (float, "Noise of the sensor, in grey levels."),
    "gamma": (float, "Of the camera; 1 is linear."),
    "jpeg_quality": (int, "Of the frames, 1 to 100."),
    "mount_height_m": (float, "How high the cameras hang, in m."),
    "marker_length_m": (float, "Side of a marker's black square, in m."),
    "tape_sigma_m": (float, "How badly the tape is read, in m."),
}


def add_commands(app: typer.Typer) -> None:
    app.command()(init)
    app.command("simulate", help=simulate.__doc__)(_simulate_command())


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


def simulate(output: Path, **settings: Any) -> None:
    """Render a lab with known truth: places measured by tape, then a drive. Unless you say otherwise it is
    the lab of the paper: three cameras of 1920 x 1080 about 2.1 m above a floor of 4.88 m."""
    from ipsys_log.runs import write_log
    from ipsys_log.sources.simulator import LabSettings, simulate

    given = {name: value for name, value in settings.items() if value is not None}
    with progress_bar() as progress:

        def counted() -> Iterator[Message]:
            for done, message in enumerate(simulate(LabSettings(**given)), 1):
                progress("simulate", done, None)
                yield message

        counts = write_log(output, counted())
    frames = sum(count for topic, count in counts.items() if topic.endswith("/image"))
    console.print(f"{output} written: {frames} frames, {counts['/measurements']} measured places")


def _simulate_command() -> Callable[..., None]:
    """:func:`simulate` with an option for each setting."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    parameters = [inspect.Parameter("output", keyword, annotation=NewLog)]
    for name, (kind, text) in SETTINGS.items():
        option = typer.Option(help=text, show_default=False)
        annotation = Annotated[kind | None, option]  # type: ignore[valid-type]
        parameters.append(inspect.Parameter(name, keyword, default=None, annotation=annotation))

    def command(**given: Any) -> None:
        simulate(**given)

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    return command
