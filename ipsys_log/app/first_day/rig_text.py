"""Changes of the text of a rig file that keep its other lines and its comments."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.messages import Rig
from ipsys_log.messages.rig_file import load_rig, toml_rows

_HEADER = re.compile(r"\s*\[{1,2}\s*([A-Za-z_]+)\s*\]{1,2}")


@dataclass(slots=True)
class _Block:
    """A table of a rig file: the comments before it, its key ("" for the first lines), and its lines."""

    lead: list[str]
    key: str
    lines: list[str] = field(default_factory=list)


def replace_values(text: str, values: Mapping[str, str | float]) -> str:
    """Return a rig file with other values at its top, such as ``name``; lines of comments stay.

    Examples
    --------
    >>> print(replace_values('name = "lab"  # ours', {"name": "hall"}), end="")
    name = "hall"
    """
    blocks = _split(text)
    lines = blocks[0].lines
    for row in _toml_rows_of(values):
        key = row.partition(" ")[0]
        number = next((n for n, line in enumerate(lines) if re.match(rf"\s*{key}\s*=", line)), None)
        if number is None:
            lines.append(row)
        else:
            lines[number] = row
    return _join(blocks)


def _toml_rows_of(values: Mapping[str, str | float]) -> list[str]:
    """Return the lines of values at the top of a rig file."""
    rig = Rig(**{"name": "", "dictionary": "", "marker_length_m": 0.0, **values})  # type: ignore[arg-type]
    return [row for row in toml_rows(rig) if row.partition(" ")[0] in values]


def replace_tables(text: str, header: str, items: Sequence[Any]) -> str:
    """Return a rig file with other tables of one kind, at the place of the first old one, else at the end.

    Parameters
    ----------
    header : the line before each table, such as ``[[cameras]]``.
    items : the new tables, as parts of a rig.
    """
    match = _HEADER.match(header)
    assert match is not None
    key, blocks = match[1], _split(text)
    old = [block for block in blocks if block.key == key]
    place = blocks.index(old[0]) if old else len(blocks)
    lead = [line for block in old for line in block.lead if line.strip()]
    new = [_Block([""], key, [header, *toml_rows(item)]) for item in items]
    if new:
        new[0].lead = ["", *lead]
    kept = [block for block in blocks[:place] if block.key != key]
    return _join([*kept, *new, *(block for block in blocks[place:] if block.key != key)])


def write_rig(path: Path, text: str, expected: Rig) -> None:
    """Write a changed rig file if it means the expected rig.

    Raises
    ------
    IpsysError
        The rig has a fault, or the file has a layout that these changes do not understand.
    """
    with TemporaryDirectory(prefix="ipsys-") as folder:
        draft = Path(folder) / path.name
        draft.write_text(text, encoding="utf-8")
        try:
            rig = load_rig(draft)
        except IpsysError as error:
            raise IpsysError(str(error).replace(str(draft), path.name)) from error
    if rig != expected:
        raise IpsysError(f"{path.name}: this page cannot change its layout; edit it in a text editor")
    with replacement_of(path) as file:
        file.write(text.encode())


def _split(text: str) -> list[_Block]:
    """Divide a rig file into its tables; comments after a blank line belong to the next table."""
    blocks = [_Block([], "")]
    for line in text.splitlines():
        header = _HEADER.match(line)
        if header is None:
            blocks[-1].lines.append(line)
            continue
        lead = _take_comments(blocks[-1].lines)
        blocks.append(_Block(lead, header[1], [line]))
    return blocks


def _take_comments(lines: list[str]) -> list[str]:
    """Remove and return the comments at the end of a table, from the first blank line after its values on."""
    last = max((n for n, line in enumerate(lines) if line.strip() and line.lstrip()[0] != "#"), default=-1)
    blank = next((n for n in range(last + 1, len(lines)) if not lines[n].strip()), len(lines))
    lead = lines[blank:]
    del lines[blank:]
    return lead


def _join(blocks: Sequence[_Block]) -> str:
    lines = [line for block in blocks for line in (*block.lead, *block.lines)]
    return "\n".join(lines).strip("\n") + "\n"
