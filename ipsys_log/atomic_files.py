"""Files that are written completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replacement_of(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file that replaces ``path`` at the end of the block.

    After an error in the block, the old file stays and the new one is removed.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # without it, a power cut may leave an empty file with the new name
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
