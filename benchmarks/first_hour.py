"""The first hour of a newcomer in the simulated lab: commands, waiting, and errors of the live tracks.

    python benchmarks/first_hour.py                      # the first commands of docs/first-day.md
    python benchmarks/first_hour.py --other ../before    # also those of another checkout

The commands run unchanged, in their order, in an empty folder. The waiting is wall time, including the
seconds of recordings. The errors are 3D, of the tracks of the live run against the simulated robots.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from results import Report, command
from rounds import Row

from ipsys_log.engine.provenance import newest_run
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import TRACKS
from ipsys_log.units import MM_PER_M

__all__ = ["measure"]

_ROOT = Path(__file__).resolve().parent.parent


def measure(options: argparse.Namespace) -> Report:
    """Play the first hour of each checkout."""
    report = Report("first_hour")
    checkouts = {"": _ROOT, ", other": Path(options.other)} if options.other else {"": _ROOT}
    for name, checkout in checkouts.items():
        with tempfile.TemporaryDirectory() as folder:
            _play(checkout, Path(folder), name, report)
    return report


def _play(checkout: Path, folder: Path, name: str, report: Report) -> None:
    from tests.cli.test_simulated_day import errors_m

    page = (checkout / "docs/first-day.md").read_text(encoding="utf-8")
    block = page[: page.index("Then look")].splitlines()
    commands = [shlex.split(line, comments=True) for line in block if line.startswith("    ipsys ")]
    seconds = []
    for words in commands:
        begin = time.perf_counter()
        program = [sys.executable, "-m", "ipsys_log", *words[1:]]
        paths = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
        done = subprocess.run(program, cwd=folder, env=paths, capture_output=True, text=True, check=False)
        seconds.append(time.perf_counter() - begin)
        if done.returncode != 0:
            raise SystemExit(f"{' '.join(words)}: {done.stderr}")
    log = folder / "monday.mcap"
    with Session([log]) as session:
        run = newest_run(session, TRACKS)
    errors_mm = errors_m(log, str(run)) * MM_PER_M
    report.rows += [
        Row(f"commands{name}", (float(len(commands)),), "count"),
        Row(f"waiting{name}", (sum(seconds) / 60,), "min"),
        Row(f"median error{name}", (float(np.median(errors_mm)),), "mm"),
        Row(f"95th percentile{name}", (float(np.percentile(errors_mm, 95)),), "mm"),
    ]
    report.details[f"seconds{name}"] = {
        " ".join(words): round(s, 1) for words, s in zip(commands, seconds, strict=True)
    }


def add_options(_group: argparse._ArgumentGroup) -> None:
    """Add no option."""


if __name__ == "__main__":
    command("first_hour")
