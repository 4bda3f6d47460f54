"""A fault of an input, tried on this checkout or on another one, and the answer."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Fault", "Outcome", "Trial", "cases_folder"]

# Benchmarks share labs and receivers with the tests.
sys.path.append(str(Path(__file__).resolve().parent.parent))

_ROOT = Path(__file__).resolve().parent.parent
_TIMEOUT_S = 900.0


def cases_folder() -> Path:
    """Return the folder of faulty inputs: that of ``IPSYS_CASES``, by default ../shared/cases.

    Raises
    ------
    SystemExit
        The folder does not exist.
    """
    folder = Path(os.environ.get("IPSYS_CASES", _ROOT / "../shared/cases")).resolve()
    if not folder.is_dir():
        raise SystemExit(f"no faulty inputs in {folder}: set IPSYS_CASES")
    return folder


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer of the program to a faulty input.

    ``is_named``: the output names the fault. ``error_mm``: median true error of the positions, or None
    without positions. ``coverage``: share of the positions whose true error is in the stated 95 % region.
    ``figure`` is a further result in words, such as "4 of 180 accepted".
    """

    is_named: bool
    error_mm: float | None = None
    coverage: float | None = None
    figure: str = ""


@dataclass(frozen=True, slots=True)
class Trial:
    """The place of a trial: an empty folder, a seed, and the package under test (a checkout)."""

    folder: Path
    seed: int
    package: Path

    def ipsys(self, *arguments: object, timeout_s: float = _TIMEOUT_S) -> str:
        """Run ``ipsys ARGUMENTS`` of the package under test; return its output and errors as one text."""
        answer = subprocess.run(
            [sys.executable, "-m", "ipsys_log", *map(str, arguments)],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(self.package), "COLUMNS": "400"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=timeout_s,
            check=False,
        )
        return answer.stdout


@dataclass(frozen=True, slots=True)
class Fault:
    """A kind of faulty input. ``is_random``: repeat it for each seed, else try it once."""

    name: str
    try_once: Callable[[Trial], Outcome]
    is_random: bool = False
