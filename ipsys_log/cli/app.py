"""All commands, by the order of a day's work."""

from __future__ import annotations

import typer

from ipsys_log.cli import derive, imports, inspect, setup, view

app = typer.Typer(
    name="ipsys",
    help="Indoor positioning with cheap cameras and ArUco markers. Everything is a channel in an MCAP log: "
    "replay it, compare models on it, look at it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for module in (setup, imports, derive, inspect, view):
    module.add_commands(app)


@app.callback(invoke_without_command=True)
def _version(
    context: typer.Context, version: bool = typer.Option(False, "--version", help="Print the version.")
) -> None:
    if version:
        from ipsys_log import __version__

        typer.echo(f"ipsys {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
