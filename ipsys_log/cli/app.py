"""All commands."""

from __future__ import annotations

import typer

from ipsys_log.cli import (
    align,
    calibrate,
    cameras,
    compare,
    imports,
    inspect,
    markers,
    measure,
    plan,
    record,
    report,
    setup,
    stages,
    view,
)
from ipsys_log.cli.guide import arrange
from ipsys_log.cli.signals import interruptible

app = typer.Typer(
    name="ipsys",
    help="Indoor positioning with cheap cameras and ArUco markers. Everything is a channel in an MCAP log: "
    "replay it, compare models on it, look at it.",
    epilog="The help of a command ends with examples: ipsys record --help. To try all of it without a "
    "camera: ipsys init lab.toml --simulated.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_MODULES = (
    *(setup, markers, cameras, calibrate, align, imports, record, measure, stages),
    *(plan, report, inspect, compare, view),
)
for module in _MODULES:
    module.add_commands(app)
arrange(app)
for typer_app in (app, *(group.typer_instance for group in app.registered_groups)):
    for command in typer_app.registered_commands if typer_app else ():
        if command.callback is not None:
            command.callback = interruptible(command.callback)


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
