"""Robots in the simulated lab: ``ipsys drive``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from ipsys_log.cli.console import console, print_json, say
from ipsys_log.cli.open_cameras import MODEL, check_target
from ipsys_log.cli.options import AsJson, Force, NewLog
from ipsys_log.cli.signals import allow_interrupt, runs_until_stopped

__all__ = ["add_commands"]


def add_commands(app: typer.Typer) -> None:
    app.command()(drive)
