"""The dataset card: the form that an author fills in, and texts that are safe in Markdown."""

import re
import tomllib
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.plain_text import plain_text

_LARGEST_FILE = 1 << 20  # bytes
_LONGEST_TEXT = 20_000
_MOST_AUTHORS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """The texts of a dataset card; a text that was not given is empty.

    Attributes
    ----------
    licence : the name of a licence, such as CC-BY-4.0.
    version : the version of the dataset, such as 1.0.0.
    measured : the description of the measurement of the calibration points.
    published : the day of publication, such as 2026-05-04.
    """

    title: str
    authors: tuple[str, ...]
    licence: str
    version: str = ""
    description: str = ""
    place: str = ""
    hardware: str = ""
    marker_sizes: str = ""
    measured: str = ""
    published: str = ""
    citation: str = ""
    url: str = ""


# The comment of each field in the form.
_FIELDS = {
    "title": "Title of the dataset. Required.",
    "authors": 'Names of the authors, such as ["Name One", "Name Two"]. Required.',
    "licence": "Licence of the data, by its SPDX name such as CC-BY-4.0 or CC0-1.0. Required.",
    "version": "Version of the dataset. Default: 1.0.0.",
    "description": "A description in some sentences.",
    "place": "Place of the recording: building, room, size of the floor.",
    "hardware": "Cameras, lenses, mounting heights, computer, robots.",
    "marker_sizes": "Side lengths of the printed markers, and how they were verified.",
    "measured": "How the calibration points were measured: instrument, reference points, heights.",
    "published": "Day of publication, such as 2026-05-04. Default: the day of the last message of the logs.",
    "citation": "The publication to cite.",
    "url": "Web address of the dataset.",
}
_REQUIRED = ("title", "authors", "licence")


def card_form() -> str:
    """Return the empty form of a dataset card."""
    lines = ["# The card of a dataset for ipsys pack. Texts that stay empty are left out.", ""]
    for name, comment in _FIELDS.items():
        lines += [f"# {comment}", f"{name} = {'[]' if name == 'authors' else _EMPTY}", ""]
    return "\n".join(lines[:-1]) + "\n"


_EMPTY = '""'


def write_card_form(path: Path) -> None:
    """Write the empty form of a dataset card."""
    if path.exists() or path.is_symlink():
        raise IpsysError(f"--card-form {path}: exists already; choose another name")
    with replacement_of(path) as file:
        file.write(card_form().encode())


def read_card(path: Path) -> Card:
    """Read and check the form of a dataset card.

    Raises
    ------
    IpsysError
        The file cannot be read, is not TOML, lacks a required text, or has an unknown key or a wrong value.
    """
    table = _read_toml(path)
    for name, value in table.items():
        if name not in _FIELDS:
            raise IpsysError(f"{path}: '{plain_text(name)}' is not a key of a card: {', '.join(_FIELDS)}")
        table[name] = _texts(value, path) if name == "authors" else _text(name, value, path)
    missing = [name for name in _REQUIRED if not table.get(name)]
    if missing:
        raise IpsysError(f"{path}: {missing[0]} is empty; write it, the dataset card needs it")
    card = Card(**table)
    _check_date(card.published, path)
    return card


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise IpsysError(f"{path}: is too large for a card; to write a form: ipsys pack --card-form")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise IpsysError(
            f"{path}: cannot be read: {error.strerror}; to write a form: ipsys pack --card-form card.toml"
        ) from error
    except UnicodeDecodeError as error:
        raise IpsysError(f"{path}: is not a text file; to write a form: ipsys pack --card-form") from error
    except (ValueError, RecursionError) as error:
        raise IpsysError(f"{path}: is not valid TOML: {plain_text(str(error))}") from error


def _text(name: str, value: object, path: Path) -> str:
    if isinstance(value, date):  # TOML has dates without quotes
        value = value.isoformat()
    if not isinstance(value, str):
        raise IpsysError(f'{path}: {name} must be a text in quotes, such as {name} = "..."')
    if len(value) > _LONGEST_TEXT:
        raise IpsysError(f"{path}: {name} has more than {_LONGEST_TEXT} characters; shorten it")
    return " ".join(value.split())


def _texts(value: object, path: Path) -> tuple[str, ...]:
    if not isinstance(value, list) or len(value) > _MOST_AUTHORS:
        raise IpsysError(f'{path}: authors must be a list of names, such as ["Name One", "Name Two"]')
    return tuple(text for text in (_text("authors", item, path) for item in value) if text)


def _check_date(text: str, path: Path) -> None:
    try:
        valid = not text or date.fromisoformat(text).isoformat() == text
    except ValueError:
        valid = False
    if not valid:
        raise IpsysError(f"{path}: published must be a day such as 2026-05-04, not '{plain_text(text)}'")


# Inline marks, references, tags, tables, mathematics, and the first sign of addresses, mentions and emoji.
_MARKS = re.compile(r"([\\`*_{}\[\]<>()|~&#$@!\"'=]|:(?=\S)|(?<=www)\.)", re.IGNORECASE)
# A number with a point, or a sign, that would begin a list or a heading.
_OPENING = re.compile(r"^(\d{0,9})([-+.)])")


def escape_markdown(text: str) -> str:
    r"""Return a text in one line that Markdown shows as it is: no marks, tags, links or table cells.

    Examples
    --------
    >>> escape_markdown("a|b <script>\n# c")
    'a\\|b \\<script\\> \\# c'
    """
    plain = plain_text(" ".join(text.split()), longest=_LONGEST_TEXT)
    return _OPENING.sub(r"\1\\\2", _MARKS.sub(r"\\\1", plain))
