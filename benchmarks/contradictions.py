"""Answers to inputs that contradict the measurements: is the fault named, and does the covariance hold?

    python benchmarks/contradictions.py --fault-seeds 100:108      # every fault; random labs for 8 seeds
    python benchmarks/contradictions.py --fault tape               # faults with this in their name
    python benchmarks/contradictions.py --package ../before        # the same inputs for another checkout
    python benchmarks/contradictions.py --before ../before         # false alarms in honest labs instead

This checkout makes the inputs; the package under test answers them through its commands. Faults that need
the folder of faulty inputs read it from IPSYS_CASES. The table is that of docs/accuracy.md.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import faulty_calibrations
import faulty_files
import faulty_images
import faulty_joint
import faulty_poses
import faulty_streams
import faulty_tapes
import unfitting_cameras
from fault_trials import Fault, Outcome, Trial
from honest_labs import compare_honest_labs
from results import Report, command
from scenes import CACHE

__all__ = ["FAULTS", "measure"]

FAULTS: Sequence[Fault] = (
    *faulty_images.FAULTS,
    *faulty_streams.FAULTS,
    *faulty_poses.FAULTS,
    *faulty_calibrations.FAULTS,
    *unfitting_cameras.FAULTS,
    *faulty_joint.FAULTS,
    *faulty_tapes.FAULTS,
    *faulty_files.FAULTS,
)


def measure(options: argparse.Namespace) -> Report:
    """Try every fault, and compare the answers with the ground truth."""
    report = Report("contradictions")
    if options.before is not None:
        compare_honest_labs(report, options)
        return report
    faults = [fault for fault in FAULTS if options.fault in fault.name]
    if options.smoke:
        faults = [fault for fault in faults if not fault.is_random][:1]
    first, last = map(int, options.fault_seeds.split(":"))
    rows = [f"{'fault':<50} {'named':>8} {'mm':>8} {'in 95 %':>8}"]
    for fault in faults:
        seeds = range(first, last) if fault.is_random else range(first, first + 1)
        outcomes = [_try(fault, seed, Path(options.package)) for seed in seeds]
        rows.append(_row(fault, outcomes))
        report.details[fault.name] = [asdict(outcome) for outcome in outcomes]
    report.tables.append("\n".join(rows))
    return report


def _try(fault: Fault, seed: int, package: Path) -> Outcome:
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        return fault.try_once(Trial(Path(folder), seed, package.resolve()))


def _row(fault: Fault, outcomes: Sequence[Outcome]) -> str:
    named = f"{sum(outcome.is_named for outcome in outcomes)} of {len(outcomes)}"
    errors_mm = [outcome.error_mm for outcome in outcomes if outcome.error_mm is not None]
    shares = [outcome.coverage for outcome in outcomes if outcome.coverage is not None]
    error = f"{statistics.median(errors_mm):.2f}" if errors_mm else "-"
    share = f"{100 * statistics.mean(shares):.0f} %" if shares else "-"
    figures = dict.fromkeys(outcome.figure for outcome in outcomes if outcome.figure)
    row = f"{fault.name:<50} {named:>8} {error:>8} {share:>8}"
    return "\n".join([row, *(f"    {line}" for line in textwrap.wrap("; ".join(figures), 74))])


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--fault", default="", metavar="TEXT", help="only faults with this in their name")
    parser.add_argument("--fault-seeds", default="100:108", metavar="FIRST:END", help="of random labs")
    parser.add_argument(
        "--package", default=str(Path(__file__).parent.parent), metavar="FOLDER", help="checkout under test"
    )
    parser.add_argument("--before", metavar="FOLDER", help="checkout to compare answers to honest labs with")
    parser.add_argument("--honest-seeds", default="500:540", metavar="FIRST:END", help="of honest labs")


if __name__ == "__main__":
    command("contradictions")
