"""The list of allowed differences: one per line, ``CASE PLACE REASON``."""

from __future__ import annotations

from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

from tests.same_bytes.differences import Difference


class AllowListError(Exception):
    """An unreadable line of an allow file."""


@dataclass(slots=True)
class _Line:
    number: int
    case: str
    place: str
    reason: str
    used: int = 0


@dataclass(slots=True)
class AllowList:
    """Allowed differences by case and place: a topic, a JSON path, a file name, or ``order`` and others.

    Both are shell patterns: ``*`` stands for any text, ``?`` for any character.
    """

    path: Path | None = None
    lines: list[_Line] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> AllowList:
        """Read an allow file; empty lines and those that begin with ``#`` are comments.

        Raises
        ------
        AllowListError
            A line has no reason.
        OSError
            The file cannot be read.
        """
        allowed = cls(path)
        for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            words = text.split(maxsplit=2)
            if not words or words[0].startswith("#"):
                continue
            if len(words) < 3:
                raise AllowListError(f"{path}: line {number}: write CASE PLACE REASON")
            allowed.lines.append(_Line(number, words[0], words[1], words[2]))
        return allowed

    def allows(self, case: str, difference: Difference) -> bool:
        """Return whether a line allows a difference, and note each such line as used."""
        matching = [
            line
            for line in self.lines
            if fnmatchcase(case, line.case) and fnmatchcase(difference.place, line.place)
        ]
        for line in matching:
            line.used += 1
        return bool(matching)

    def unused(self, cases: list[str]) -> list[str]:
        """Describe the unused lines of the cases that ran."""
        return [
            f"{self.path}: line {line.number} is not used: {line.case} {line.place}"
            for line in self.lines
            if not line.used and any(fnmatchcase(case, line.case) for case in cases)
        ]
