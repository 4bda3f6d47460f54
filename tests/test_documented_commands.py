"""The commands on the pages exist, with their options."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from ipsys_log.app.cli.app import app
from ipsys_log.errors import IpsysError
from ipsys_log.log.reader import LogReader
from ipsys_log.plain_text import shell_words
from tests.conftest import ROOT
from tests.site_pages import staging

_IPSYS: Any = typer.main.get_command(app)
# A command in a block of code, perhaps on several lines, or in inline code.
_BLOCK = re.compile(r"(?m)^(?: {4,}|\$ )(?:\$ )?(?:\S*bin/)?ipsys +((?:[^#\n]*\\\n)*[^#\n]*)")
_INLINE = re.compile(r"`ipsys +([^`]+)`")


def documented(text: str) -> Iterator[list[str]]:
    """Yield the words of each command on a page."""
    for found in (*_BLOCK.finditer(text), *_INLINE.finditer(text)):
        yield re.sub(r"'[^']*'|\"[^\"]*\"", "x", found[1].replace("\\\n", " ")).split()


def command_fault(words: list[str]) -> str | None:
    """Return the fault of a command, or None."""
    command = _IPSYS
    for word in words:
        if word.startswith("-") or word not in getattr(command, "commands", {}):
            break
        command = command.commands[word]
    if command is _IPSYS and not words[0].startswith(("-", "[")):
        return f"no command {words[0]}"
    known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    known |= {"--help", "-h"}
    # As in `--view` and `--rerun` of `live`: an option ends at the first character of another kind.
    options = [found[0] for word in words if (found := re.match(r"--?[a-z][a-z0-9-]*", word))]
    unknown = [option for option in options if option not in known]
    return f"{command.name} has no {', '.join(unknown)}" if unknown else None


# Pages on the past name commands as they were.
_HISTORY = ("CHANGELOG.md", "docs/decisions")
_PAGES = [page for page in staging["pages"]() if not str(page.relative_to(ROOT)).startswith(_HISTORY)]


@pytest.mark.parametrize("page", _PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_of_a_page_exist(page: Path) -> None:
    commands = [words for words in documented(page.read_text(encoding="utf-8")) if words]
    assert [(words, fault) for words in commands if (fault := command_fault(words))] == []


def test_wrong_commands_are_found() -> None:
    text = (
        "    ipsys detekt x\n\n    ipsys live -o x \\\n        --udb 9870    # --nothing\n\n`ipsys plan --x`"
    )
    faults = [command_fault(words) for words in documented(text)]
    assert faults == ["no command detekt", "live has no --udb", "plan has no --x"]
    assert command_fault(["batch", "replay", "logs", "--table", "x.parquet"]) is None


def test_commands_of_the_pages_are_seen() -> None:
    pages = [path.read_text(encoding="utf-8") for path in staging["pages"]() if path.name != "commands.md"]
    assert sum(len(list(documented(text))) for text in pages) > 300


def test_suggested_command_has_the_name_as_one_word(tmp_path: Path) -> None:
    log = tmp_path / "a b.mcap"
    log.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(IpsysError, match=re.escape(f"ipsys repair '{log}'")):
        LogReader(log)
    assert shell_words(log, "c.mcap") == f"'{log}' c.mcap"
