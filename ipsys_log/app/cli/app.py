"""The command ``ipsys``: all commands in their groups, their help, and old names."""

import copy
import functools
import re
import shlex
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from inspect import cleandoc
from itertools import chain
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from ipsys_log.app.cli.console import remarks, say
from ipsys_log.app.cli.signals import interruptible
from ipsys_log.stages import STAGE_NAMES

# The commands of the first help screen, in its order, with their purpose as their docstrings state it: the
# screen imports no command.
_FIRST: dict[str, dict[str, str]] = {
    "First day, in this order": {
        "setup": "Set a lab up on a page, step by step: rig, cameras, intrinsics, points, fit, and the live "
        "view.",
        "init": "Write a rig file to edit: markers, cameras, reference points, floor. With comments, or "
        "from a log.",
        "markers": "Draw markers and calibration boards as a PDF at true size, with a ruler to check the "
        "print.",
        "cameras": "List the USB cameras with device, modes, bus and hub, and check that USB is fast enough "
        "for all.",
        "calibrate": "Calibrate camera intrinsics from images of a chessboard or a ChArUco board.",
        "align": "Show the tilt that makes each camera look straight down, and the floor that all cameras "
        "see.",
        "record": "Record the camera frames, unchanged, until Ctrl-C.",
        "measure": "Enter the tape measurements of a log: on a page for the phone, in the terminal, or from "
        "a sheet.",
        "calibrate-lab": "Calibrate all cameras of a lab together, from drives of robots and a few "
        "measured points.",
        "replay": "Run the missing stages of a log, append their results to it, and print the accuracy.",
        "live": "Track robots live: record, and process every frame with all stages up to fuse, until "
        "Ctrl-C.",
    },
    "Results": {
        "evaluate": "Evaluate models: their errors, the learning curve and outliers of the measurements.",
        "plan": "Propose the next points to measure, which reduce the predicted error over the floor most.",
        "report": "Write an HTML page on a session: its accuracy, its recording and its runs.",
        "info": "Show cameras, channels, counts, rates, gaps and runs of a log.",
        "view": "Show frames with drawn markers, floor, calibration points, positions and tracks over time, "
        "in Rerun.",
        "export": "Export positions, images or another channel to a file for other programs.",
        "import": "Import recordings, tables or ground truth of other programs into a log.",
    },
}
# Each of these groups has one line there.
_FURTHER: dict[str, tuple[str, ...]] = {
    "Accuracy": ("exclude", "drift", "compare", "calibrate-body"),
    "Logs": ("check", "cat", "stream", "cut", "merge", "verify", "repair"),
    "Datasets": ("catalogue", "pack", "score"),
    "Other hosts": ("node",),
    "Simulated lab": ("simulate", "drive"),
    "Many logs": ("batch",),
}
# The commands by their module; a command imports only its own.
_MODULES: dict[str, tuple[str, ...]] = {
    "batch": ("batch",),
    "calibrate": ("calibrate",),
    "calibrate_body": ("calibrate-body",),
    "calibrate_lab": ("calibrate-lab",),
    "compare": ("compare",),
    "camera_poses": ("align", "drift"),
    "datasets": ("catalogue", "pack", "score"),
    "imports": ("import",),
    "log_copies": ("cut", "merge"),
    "logs": ("info", "check", "cat", "verify", "repair"),
    "node": ("node",),
    "points": ("measure", "plan", "exclude"),
    "record": ("record", "live"),
    "setup": ("setup", "init", "markers", "cameras"),
    "simulated": ("simulate", "drive"),
    "stages": ("replay", "evaluate"),
    "stream": ("stream",),
    "views": ("report", "view", "export"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

# Old names of commands work for one release; no help shows them.
_OLD_NAMES: dict[str, tuple[str, ...]] = {
    "runs": ("info", "--runs"),
    "du": ("info", "--sizes"),
    "latency": ("info", "--latency"),
    "diff": ("verify", "--compare"),
    "compact": ("cut", "--compact"),
    **{name: ("replay", "--until", name) for name in STAGE_NAMES if name != "evaluate"},
}
_SIMULATE = ("--output", "--cameras", "--seed", "--settings", "--set", "--help")


def present_words(words: list[str]) -> list[str]:
    """Return the words of a command line with the present names of commands.

    Examples
    --------
    >>> present_words(["runs", "monday.mcap"])
    ['info', '--runs', 'monday.mcap']
    >>> present_words(["simulate", "-o", "lab.mcap", "--drive-s", "4"])
    ['simulate', '-o', 'lab.mcap', '--set', 'drive_s=4']
    """
    words = [re.sub("^--plots(?==|$)", "--plot", word) for word in words]
    name, *rest = words
    if name in _OLD_NAMES:
        return [*_OLD_NAMES[name], *rest]
    if name == "import" and rest and _is_kind(*rest):
        return ["import", "--as", *rest]
    if name == "measure" and any(word.partition("=")[0] in ("-o", "--output") for word in rest):
        return ["record", "--measure", "--points-only", *rest]
    return [name, *_settings(rest)] if name == "simulate" else words


def _is_kind(name: str, *further: str) -> bool:
    """Return whether the first word after ``import`` is a kind, and not a folder of that name."""
    from ipsys_log.app.cli.imports import KINDS

    return name in KINDS and (not Path(name).exists() or bool(further and not further[0].startswith("-")))


def _settings(words: list[str]) -> list[str]:
    """Return the words of ``simulate`` with ``--set`` in place of an option for each setting."""
    remaining, present = iter(words), []
    for word in remaining:
        option, equals, value = word.partition("=")
        if option.startswith("--") and option not in _SIMULATE:
            setting = option.removeprefix("--").replace("-", "_")
            present += ["--set", f"{setting}={value if equals else next(remaining, '')}"]
        else:
            present.append(word)
    return present


class _Commands(Mapping[str, Any]):
    """The commands by name; asking for a command imports its module."""

    def __getitem__(self, name: str) -> Any:
        return _load(name, _MODULE_OF[name])

    def __iter__(self) -> Iterator[str]:
        return chain(*panels().values())

    def __len__(self) -> int:
        return len(_MODULE_OF)


class Commands(TyperGroup):
    """The commands, by their present and their old names; the help lists the first ones."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Mapping[str, Any] = _Commands()  # type: ignore[assignment]

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name, the command and its words."""
        words = present_words(args)
        if words != args and remarks.is_terminal:
            say(f"old names work until the next release; now: ipsys {shlex.join(words)}")
        return super().resolve_command(ctx, words)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the first commands with their purpose; the epilog has the others."""
        first = copy.copy(self)
        first.commands = {
            name: TyperCommand(name, help=purpose, rich_help_panel=group)
            for group, commands in _FIRST.items()
            for name, purpose in commands.items()
        }
        super(Commands, first).format_help(ctx, formatter)


@functools.cache
def _load(name: str, module: str) -> Any:
    """Return the command of a module, as the parser needs it."""
    from ipsys_log.app.cli.options import needs_local_files

    def wrapped(command: Callable[..., Any]) -> Callable[..., Any]:
        return interruptible(needs_local_files(_with_one_reading(command)))

    loaded = import_module(f"ipsys_log.app.cli.{module}")
    if name == "batch":
        return get_command(loaded.make_group(wrapped))
    command = getattr(loaded, "import_" if name == "import" else name.replace("-", "_"))
    text, _, examples = cleandoc(command.__doc__ or "").partition("\n\nExamples\n\n")
    single = typer.Typer(add_completion=False)
    single.command(name, help=_unwrapped(text), epilog=f"Examples\n\n{examples}")(wrapped(command))
    return get_command(single)


def purposes() -> dict[str, str]:
    """Return the purposes of the commands of the first help screen, by their names."""
    return {name: purpose for commands in _FIRST.values() for name, purpose in commands.items()}


def panels() -> dict[str, tuple[str, ...]]:
    """Return the names of all commands by their groups."""
    return {group: tuple(commands) for group, commands in (_FIRST | _FURTHER).items()}


def _epilog() -> str:
    lines = [f"{group}: {', '.join(panels()[group])}" for group in _FURTHER]
    return (
        "More commands\n\n"
        + "\n".join(f"    {line}" for line in lines)
        + "\n\nThe help of a command ends with examples: ipsys record --help. To try all commands without a "
        "camera: ipsys init lab.toml --simulated. docs/glossary.md explains the terms."
    )


def _unwrapped(text: str) -> str:
    """Return a help text with one line for each paragraph: the terminal wraps them."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in cleandoc(text).split("\n\n"))


def _with_one_reading(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command: it parses the summary of each log once."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> Any:
        from ipsys_log.log.known_contents import one_reading

        with one_reading():
            return command(*arguments, **options)

    return run


app = typer.Typer(
    name="ipsys",
    cls=Commands,
    help="Find the positions of robots indoors, with cheap cameras and ArUco markers. An MCAP log has all "
    "data: replay the log, compare models, view the results.",
    epilog=_epilog(),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from ipsys_log import __version__

        typer.echo(f"ipsys {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Options of ``ipsys`` itself; the help is that of the application."""
