"""The machine and the software of a benchmark."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

__all__ = ["facts"]

_PACKAGES = (
    "opencv-python-headless",
    "numpy",
    "simplejpeg",
    "mcap",
    "protobuf",
    "foxglove-sdk",
    "pupil-apriltags",
)
# Environment variables that change threads and the heap.
_VARIABLES = ("MALLOC_", "GLIBC_TUNABLES", "OMP_", "OPENBLAS_", "OPENCV_", "LD_PRELOAD")


def facts() -> dict[str, Any]:
    """Return processor, memory, load, versions, and the measured commit."""
    memory = next((line.split()[1] for line in _lines("/proc/meminfo") if line.startswith("MemTotal")), "0")
    return {
        "when": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "cpu": next(
            (line.partition(":")[2].strip() for line in _lines("/proc/cpuinfo") if "model name" in line),
            platform.processor(),
        ),
        "cores": os.cpu_count(),
        "memory_gb": round(int(memory) / 1e6, 1),
        "system": platform.platform(),
        "load_at_start": os.getloadavg(),
        "environment": {name: value for name, value in os.environ.items() if name.startswith(_VARIABLES)},
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "commit": _git("rev-parse", "--short", "HEAD"),
        "package_changed_since": bool(_git("status", "--porcelain", "ipsys_log")),
    }


def _lines(path: str) -> list[str]:
    return Path(path).read_text(encoding="utf-8").splitlines() if Path(path).exists() else []


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _git(*arguments: str) -> str | None:
    try:
        command = ["git", "-C", str(Path(__file__).parent.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
