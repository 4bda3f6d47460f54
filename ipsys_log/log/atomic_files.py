"""Files that are written completely or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replacement_of(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file that replaces ``path`` at the end of the block.

    After an error in the block, the old file stays and the new one is removed.
    """
    partial = partial_of(path)
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # without it, a power cut may leave an empty file with the new name
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def partial_of(path: Path) -> Path:
    """Return the name of this process for the unfinished file; remove the files of processes that have ended.

    Such a file remains if its process was killed, or interrupted right after the creation of the file.
    """
    for file in path.parent.glob(f"{escape(path.name)}.*.partial*"):
        number = file.name.removeprefix(f"{path.name}.").partition(".")[0]
        if number.isdecimal() and not _is_running(int(number)):
            file.unlink(missing_ok=True)
    return path.with_name(f"{path.name}.{os.getpid()}.partial")


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
