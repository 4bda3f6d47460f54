"""Packages of npm for tests, in a folder of the cache."""

import fcntl
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT

_LIMIT_S = 240


def install(folder: str, *packages: str) -> Path:
    """Return a folder of the cache with packages; skip the test if they cannot be installed."""
    home = ROOT / ".cache" / folder
    home.mkdir(parents=True, exist_ok=True)
    with (home / "lock").open("w") as lock:  # two test processes must not install at the same time
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (home / "complete").exists():
            _install(home, packages)
    return home


def _install(home: Path, packages: tuple[str, ...]) -> None:
    command = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(home), *packages]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LIMIT_S, check=False)
    except (FileNotFoundError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"{packages[0]} cannot be installed: {error}")
    if done.returncode:
        pytest.skip(f"{packages[0]} cannot be installed: {done.stderr.strip().splitlines()[:2]}")
    (home / "complete").touch()
