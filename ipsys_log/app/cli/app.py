"""The command ``ipsys``: all commands in their groups, their help, and old names."""

from __future__ import annotations

import copy
import functools
import shlex
from collections.abc import Callable
from inspect import cleandoc
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from ipsys_log.app.cli import batch
from ipsys_log.app.cli.calibrate import calibrate
from ipsys_log.app.cli.calibrate_lab import calibrate_lab
from ipsys_log.app.cli.camera_poses import align, drift
from ipsys_log.app.cli.console import remarks, say
from ipsys_log.app.cli.datasets import catalogue, pack, score
from ipsys_log.app.cli.imports import KINDS, import_
from ipsys_log.app.cli.log_copies import cut, merge
from ipsys_log.app.cli.logs import cat, check, info, repair, verify
from ipsys_log.app.cli.node import node
from ipsys_log.app.cli.options import needs_local_files
from ipsys_log.app.cli.points import exclude, measure, plan
from ipsys_log.app.cli.record import live, record
from ipsys_log.app.cli.setup import cameras, init, markers, setup
from ipsys_log.app.cli.signals import interruptible
from ipsys_log.app.cli.simulated import drive, simulate
from ipsys_log.app.cli.stages import STAGE_NAMES, evaluate, replay
from ipsys_log.app.cli.stream import stream
from ipsys_log.app.cli.views import export, report, view

Command = Callable[..., None]

# The commands of the first help screen, in its order.
_FIRST: dict[str, tuple[Command, ...]] = {
    "First day, in this order": (
        *(setup, init, markers, cameras, calibrate, align, record, measure, calibrate_lab, replay, live),
    ),
    "Results": (evaluate, plan, report, info, view, export, import_),
}
# Each of these groups has one line there.
_FURTHER: dict[str, tuple[Command, ...]] = {
    "Accuracy": (exclude, drift),
    "Logs": (check, cat, stream, cut, merge, verify, repair),
    "Datasets": (catalogue, pack, score),
    "Other hosts": (node,),
    "Simulated lab": (simulate, drive),
}
_BATCH = "Many logs"

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
    name, *rest = words
    if name in _OLD_NAMES:
        return [*_OLD_NAMES[name], *rest]
    if name == "import" and rest and rest[0] in KINDS and _is_kind(*rest):
        return ["import", "--as", *rest]
    if name == "measure" and any(word.partition("=")[0] in ("-o", "--output") for word in rest):
        return ["record", "--measure", "--points-only", *rest]
    return [name, *_settings(rest)] if name == "simulate" else words


def _is_kind(name: str, *further: str) -> bool:
    """Return whether the first word after ``import`` is a kind, and not a folder of that name."""
    return not Path(name).exists() or bool(further and not further[0].startswith("-"))


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


class Commands(TyperGroup):
    """The commands, by their present and their old names; the help lists the first ones."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name, the command and its words."""
        words = present_words(args)
        if words != args and remarks.is_terminal:
            say(f"ipsys {args[0]} is an old name until the next release; now: ipsys {shlex.join(words)}")
        return super().resolve_command(ctx, words)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the first commands with their purpose; the epilog has the others."""
        first = copy.copy(self)
        first.commands = {name: self.commands[name] for names in _names(_FIRST).values() for name in names}
        super(Commands, first).format_help(ctx, formatter)


def panels() -> dict[str, tuple[str, ...]]:
    """Return the names of all commands by their groups."""
    return {**_names(_FIRST), **_names(_FURTHER), _BATCH: ("batch",)}


def _names(groups: dict[str, tuple[Command, ...]]) -> dict[str, tuple[str, ...]]:
    return {group: tuple(map(_name, commands)) for group, commands in groups.items()}


def _name(command: Command) -> str:
    return command.__name__.strip("_").replace("_", "-")


def _epilog() -> str:
    lines = [f"{group}: {', '.join(panels()[group])}" for group in (*_FURTHER, _BATCH)]
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


def _wrapped(command: Callable[..., Any]) -> Callable[..., Any]:
    return interruptible(needs_local_files(_with_one_reading(command)))


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
# The lines of the examples by command, each at most 76 columns.
EXAMPLES: dict[str, list[str]] = {}
for group, commands in {**_FIRST, **_FURTHER}.items():
    for command in commands:
        text, _, examples = cleandoc(command.__doc__ or "").partition("\n\nExamples\n\n")
        EXAMPLES[_name(command)] = cleandoc(examples).splitlines()
        app.command(
            _name(command), help=_unwrapped(text), epilog=f"Examples\n\n{examples}", rich_help_panel=group
        )(_wrapped(command))
batch.add_commands(app, _BATCH, _wrapped)


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
