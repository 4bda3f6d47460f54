"""Commands that messages suggest can be pasted into a shell: names of files in them are quoted."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from ipsys_log.app.cli.app import app
from ipsys_log.errors import IpsysError
from ipsys_log.log.reader import LogReader
from ipsys_log.plain_text import shell_words
from tests.conftest import ROOT

_PACKAGE = ROOT / "ipsys_log"
# The end of a text that begins a command: its next word is a value.
_BEGUN = re.compile(r"\bipsys ([a-z][a-z-]*)(?: [^;:,.()'\"]*)? $")
_COMMANDS = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
# Words of a command that are no names of files of the user, or are already quoted.
_NO_FILES = {"logs", "names", "model", "option", "options", "models", "named", "node", "camera"}


def unquoted(source: str) -> Iterator[str]:
    """Yield the values in suggested commands of a source that are no words of a shell."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.JoinedStr):
            continue
        before = ""
        for part in node.values:
            if isinstance(part, ast.Constant):
                before += str(part.value)
                continue
            assert isinstance(part, ast.FormattedValue)
            found = _BEGUN.search(before)
            value = ast.unparse(part.value)
            if (
                found
                and found[1] in _COMMANDS
                and not value.startswith("shell_words(")
                and value not in _NO_FILES
            ):
                yield f"line {node.lineno}: ipsys {found[1]} ... {value}"
            before += "x"


def test_names_in_suggested_commands_are_quoted() -> None:
    found = {path: [*unquoted(path.read_text(encoding="utf-8"))] for path in _PACKAGE.rglob("*.py")}
    assert {path: values for path, values in found.items() if values} == {}


def test_suggested_command_has_the_name_as_one_word(tmp_path: Path) -> None:
    log = tmp_path / "a b.mcap"
    log.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(IpsysError, match=re.escape(f"ipsys repair '{log}'")):
        LogReader(log)
    assert shell_words(log, "c.mcap") == f"'{log}' c.mcap"
