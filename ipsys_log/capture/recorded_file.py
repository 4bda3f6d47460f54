"""The file of a recording: another program can rename, move or delete it while it grows."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Self

# Linux names the present path of each open file here; other systems do not.
_OPEN_FILES = Path("/proc/self/fd")


class RecordedFile:
    """An open file that is found again after a change of its name.

    Parameters
    ----------
    path : its name at first.
    fd : its descriptor, which the caller closes.
    """

    def __init__(self, path: Path, fd: int) -> None:
        self._path, self._fd = path, fd

    @classmethod
    def open(cls, path: Path) -> Self | None:
        """Open a file with a descriptor of its own; None if there is no such file."""
        try:
            return cls(path, os.open(path, os.O_RDONLY))
        except OSError:
            return None

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self._fd)

    @property
    def size(self) -> int:
        """The size of the file in bytes."""
        return os.fstat(self._fd).st_size

    @property
    def is_deleted(self) -> bool:
        """True if the file has no name any more; a fault of the disk is no proof of that."""
        try:
            return os.fstat(self._fd).st_nlink == 0
        except OSError:
            return False

    def find(self) -> Path | None:
        """Return the present path; None if the file is deleted, or the system does not tell its path."""
        if self._is_at(self._path):
            return self._path
        try:
            present = (_OPEN_FILES / str(self._fd)).readlink()
        except OSError:
            return None
        # A name in the same folder keeps the form in which the user gave the folder.
        candidates = (self._path.with_name(present.name), present)
        return next((path for path in candidates if self._is_at(path)), None)

    def _is_at(self, path: Path) -> bool:
        try:
            return os.path.samestat(os.fstat(self._fd), path.stat())
        except (OSError, ValueError):
            return False
