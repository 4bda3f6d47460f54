"""The manifest of a pack, in the Croissant format, and its members: their names, checksums and limits.

References
----------
Croissant Format Specification 1.0, MLCommons, http://mlcommons.org/croissant/1.0. The context is the one of
the specification, with the prefix ``ipsys`` for the version of the pack.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn

from ipsys_log.errors import IpsysError
from ipsys_log.plain_text import plain_text
from ipsys_log.tools.publish.card import Card

MANIFEST, CHECKSUMS = "croissant.json", "SHA256SUMS"
README, RIG_FILE, SCORES, LOGS = "README.md", "lab.toml", "scores.json", "logs"

# A session has a few logs; the limits stop a hostile pack before any work.
MAX_MEMBERS = 1000
LARGEST_TEXT = 1 << 20  # bytes of the manifest, of the checksums and of the scores
_LONGEST_NAME = 200
_PIECE = 1 << 20  # bytes that are copied at once

_PART = r"[A-Za-z0-9_][A-Za-z0-9._-]*"
_NAME = re.compile(rf"{_PART}(/{_PART})*")


class Member(NamedTuple):
    """A file of a pack: its name relative to the pack, its size in bytes, and its SHA-256 in hexadecimal."""

    name: str
    size: int
    sha256: str


def check_member_name(name: str, where: str) -> str:
    """Return the name of a member if it stays inside the folder of the pack.

    Allowed are parts of letters, digits, ``_``, ``-`` and ``.``, separated by ``/``. No part begins with a
    dot. So a name is never absolute, and has no ``..``, backslash, drive or control character.

    Examples
    --------
    >>> check_member_name("logs/monday.mcap", "pack")
    'logs/monday.mcap'
    """
    if len(name) > _LONGEST_NAME or not _NAME.fullmatch(name):
        raise IpsysError(
            f"{where}: the name '{plain_text(name, longest=80)}' is refused: names of files in a pack are "
            "relative, of letters, digits, _, - and .; pack the dataset again with ipsys pack"
        )
    return name


def check_unique(names: Iterable[str], where: str) -> None:
    """Check that no two names are equal, in upper or lower case: some file systems do not distinguish them.

    Raises
    ------
    IpsysError
        Two names are equal, or a name is also the folder of another.
    """
    known: set[str] = set()
    folders: set[str] = set()
    for name in names:
        folded = name.casefold()
        parts = folded.split("/")[:-1]
        own_folders = {"/".join(parts[: count + 1]) for count in range(len(parts))}
        if folded in known | folders or own_folders & known:
            raise IpsysError(f"{where}: has {name} twice; pack the dataset again with ipsys pack")
        known.add(folded)
        folders |= own_folders


def free_member_name(stem: str, names: Iterable[str]) -> str:
    """Return the name of a log in a pack, made from the stem of its file name and different from ``names``.

    Examples
    --------
    >>> free_member_name("../Tag 1", []), free_member_name("a", ["logs/a.mcap"])
    ('logs/Tag_1.mcap', 'logs/a_2.mcap')
    """
    clean = re.sub(r"[^A-Za-z0-9_-]+", "_", stem)[:80].strip("_-") or "log"
    known = {name.casefold() for name in names}
    name, number = f"{LOGS}/{clean}.mcap", 2
    while name.casefold() in known:
        name, number = f"{LOGS}/{clean}_{number}.mcap", number + 1
    return name


def copy_member(source: BinaryIO, target: BinaryIO | None, size: int) -> tuple[int, str]:
    """Copy at most ``size`` + 1 bytes; return the number of copied bytes and their SHA-256.

    ``target`` is None to compute the checksum only. A source with more bytes than stated is not read to its
    end.
    """
    digest, copied = hashlib.sha256(), 0
    while copied <= size and (piece := source.read(min(_PIECE, size + 1 - copied))):
        digest.update(piece)
        copied += len(piece)
        if target is not None:
            target.write(piece)
    return copied, digest.hexdigest()


def describe_member(folder: Path, name: str) -> Member:
    """Return a file of a folder as a member, with its checksum."""
    path = folder / name
    with path.open("rb") as file:
        size, sha256 = copy_member(file, None, path.stat().st_size)
    return Member(name, size, sha256)


def checksum_lines(members: Iterable[Member]) -> str:
    """Return the text of ``SHA256SUMS``, which ``sha256sum --check`` reads."""
    return "".join(f"{member.sha256}  {member.name}\n" for member in members)


# The version of the layout of packs; it rises when an older ipsys cannot read a newer pack.
PACK_VERSION = 1
_VERSION_KEY = "ipsys:packVersion"
_CROISSANT = "http://mlcommons.org/croissant/1.0"
_FIRST_VERSION = "1.0.0"
_REFUSED = "pack the dataset again with ipsys pack"

_FORMATS = {
    ".mcap": "application/x-mcap",
    ".json": "application/json",
    ".md": "text/markdown",
    ".toml": "application/toml",
}
_CONTENTS = {
    README: "The dataset card.",
    RIG_FILE: "The rig: cameras, markers and reference points. The logs contain it too.",
    SCORES: "The expected errors of all models, with tolerances.",
}

# The context of the specification, appendix 1.
_TERMS = (
    *("citeAs", "column", "equivalentProperty", "extract", "field", "fileObject", "fileProperty", "fileSet"),
    *("format", "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet"),
    *("references", "regex", "repeated", "replace", "samplingRate", "separator", "source", "subField"),
    "transform",
)
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "ipsys": "urn:ipsys:",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _TERMS},
}
_TYPES = {"text": "sc:Text", "integer": "sc:Integer", "number": "sc:Float"}


@dataclass(frozen=True, slots=True)
class Manifest:
    """The content of a manifest: the title of the dataset, and all other files but the checksums."""

    title: str
    members: tuple[Member, ...]

    @property
    def logs(self) -> list[str]:
        """Return the names of the logs, in the order in which they are read as one session."""
        return [member.name for member in self.members if member.name.endswith(".mcap")]


def build_manifest(
    card: Card, published: str, members: Sequence[Member], score_fields: Mapping[str, str]
) -> dict[str, Any]:
    """Return the manifest as plain data.

    Parameters
    ----------
    card : the texts of the author.
    published : the day of publication, such as 2026-05-04.
    members : all files but the manifest and the checksums.
    score_fields : the columns of the scores: ``text``, ``integer`` or ``number`` by name.
    """
    texts = {
        "name": card.title,
        "description": card.description or card.title,
        "license": card.licence,
        "url": card.url,
        "citeAs": card.citation or f"{', '.join(card.authors)}: {card.title}, {published[:4]}",
        "datePublished": published,
        "version": card.version or _FIRST_VERSION,
    }
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": _CROISSANT,
        _VERSION_KEY: PACK_VERSION,
        **{key: text for key, text in texts.items() if text},
        "creator": [{"@type": "sc:Person", "name": name} for name in card.authors],
        "distribution": [_file_object(member) for member in members],
        "recordSet": [_score_records(score_fields)],
    }


def _file_object(member: Member) -> dict[str, Any]:
    suffix = member.name[member.name.rfind(".") :]
    return {
        "@type": "cr:FileObject",
        "@id": member.name,
        "name": member.name,
        "description": _CONTENTS.get(member.name, "A log: all channels of a session, in MCAP."),
        "contentUrl": member.name,
        "contentSize": f"{member.size} B",
        "encodingFormat": _FORMATS[suffix],
        "sha256": member.sha256,
    }


def _score_records(fields: Mapping[str, str]) -> dict[str, Any]:
    """Return the scores as a table that programs for Croissant can read."""
    return {
        "@type": "cr:RecordSet",
        "@id": "scores",
        "name": "scores",
        "description": "The expected errors: a row for each model, scheme, reference and dimension.",
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"scores/{name}",
                "name": name,
                "dataType": _TYPES[kind],
                "source": {"fileObject": {"@id": SCORES}, "extract": {"jsonPath": f"$.scores[*].{name}"}},
            }
            for name, kind in fields.items()
        ],
    }


def json_text(value: Any) -> str:
    """Return plain data as the text of a file."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def parse_json(data: bytes, where: str) -> dict[str, Any]:
    """Return the object of a JSON file."""
    try:
        value = json.loads(data.decode(), parse_constant=_refuse_constant, parse_float=_finite)
    except RecursionError as error:
        raise IpsysError(f"{where}: is nested too deep; {_REFUSED}") from error
    except ValueError as error:  # of the decoding too; the text of Python names line and column
        raise IpsysError(f"{where}: is not valid JSON: {plain_text(str(error))}; {_REFUSED}") from error
    if not isinstance(value, dict):
        raise IpsysError(f"{where}: is not a JSON object; {_REFUSED}")
    return value


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is too large")
    return value


def parse_manifest(data: bytes, where: str) -> Manifest:
    """Return the content of a manifest.

    Raises
    ------
    IpsysError
        The file is not a manifest of a pack, belongs to a newer version, or names a file that is refused.
    """
    where = f"{where}: {MANIFEST}"
    table = parse_json(data, where)
    version = table.get(_VERSION_KEY)
    if type(version) is not int or version < 1:
        raise IpsysError(f"{where}: is not the manifest of a pack; give the folder or the .zip of ipsys pack")
    if version > PACK_VERSION:
        raise IpsysError(f"{where}: has version {version}, and this ipsys reads {PACK_VERSION}; update ipsys")
    title = table.get("name")
    if not isinstance(title, str) or not title:
        raise IpsysError(f"{where}: has no name; {_REFUSED}")
    members = tuple(_parse_members(table.get("distribution"), where))
    check_unique([*(member.name for member in members), MANIFEST, CHECKSUMS], where)
    manifest = Manifest(title, members)
    if SCORES not in {member.name for member in members} or not manifest.logs:
        raise IpsysError(f"{where}: names no log or no {SCORES}; {_REFUSED}")
    return manifest


def _parse_members(rows: object, where: str) -> Iterator[Member]:
    if not isinstance(rows, list) or len(rows) > MAX_MEMBERS:
        raise IpsysError(f"{where}: distribution is not a list of at most {MAX_MEMBERS} files; {_REFUSED}")
    for number, row in enumerate(rows, 1):
        texts = [row.get(key) if isinstance(row, dict) else None for key in _MEMBER_KEYS]
        if not all(isinstance(text, str) for text in texts):
            raise IpsysError(f"{where}: file {number} needs the texts {', '.join(_MEMBER_KEYS)}; {_REFUSED}")
        name, size, sha256 = map(str, texts)
        check_member_name(name, where)
        if not re.fullmatch(r"[0-9]{1,15} B", size) or not re.fullmatch(r"[0-9a-f]{64}", sha256):
            raise IpsysError(f"{where}: {name} has no size in bytes, or no SHA-256; {_REFUSED}")
        yield Member(name, int(size.removesuffix(" B")), sha256)


_MEMBER_KEYS = ("contentUrl", "contentSize", "sha256")
