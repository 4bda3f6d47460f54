"""What the tests share: the real data, and the command line run in this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from ipsys_log.cli import main

ROOT = Path(__file__).resolve().parent.parent


class Done(NamedTuple):
    code: int
    out: str
    err: str


Ipsys = Callable[..., Done]


@pytest.fixture(scope="session")
def data() -> Path:
    """The public data sets; docs/data.md says where they come from."""
    folder = Path(os.environ.get("IPSYS_DATA", ROOT / "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data in {folder}: set IPSYS_DATA (docs/data.md says where to get them)")
    return folder


@pytest.fixture
def ipsys(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ipsys:
    """Run a command as a user does; exit code, stdout and stderr."""

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["ipsys", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        captured = capsys.readouterr()
        return Done(code, captured.out, captured.err)

    return run
