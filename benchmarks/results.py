"""Results of benchmarks: a table for the terminal and a file, ratios first."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from machine import facts
from rounds import Row

__all__ = ["BENCHMARKS", "Report", "command", "parser_of", "run_all"]

# Benchmarks share labs and receivers with the tests.
sys.path.append(str(Path(__file__).resolve().parent.parent))

BENCHMARKS = {
    "detection": "from a log to corners, beside a plain loop, a decoder and AprilTag",
    "replay": "the whole chain beside detection alone; memory over ten minutes",
    "jobs": "detection with worker processes, beside one process; latency after a reset",
    "live": "recording and tracking of streams on loopback: drops, processor time, latency",
    "hall_nodes": "markers of 24 nodes at one centre: processor time, latency, losses, memory",
    "streams": "from a frame to ten clients of UDP, MAVLink, VRPN, ROS 2 and Foxglove",
    "log_write": "recording and small messages, beside mcap and foxglove-sdk",
    "log_read": "reading, beside mcap",
    "table": "a channel as a table, beside decoding its messages",
    "batch": "many logs by one worker and by two, overhead for each log, memory of the driver",
    "batch_pieces": "one long log by one worker and by two, overhead of the cluster, memory of the workers",
    "handling": "cut, compact, merge, check and view of whole logs, beside cp; memory",
    "remote": "requests and bytes for a log in an S3 server, beside mcap through s3fs",
    "node_clock": "error of the clocks of nodes, in simulated exchanges",
    "node_cost": "processor time of a node and of its centre, beside a plain recording",
    "checkouts": "speed of this checkout, compared with another one",
    "answers": "start of commands, evaluations, report and calibrate-lab",
    "first_hour": "commands, waiting and errors of the first day in the simulated lab",
    "robot_run": "control error and true error of robots at waypoints, without and with faults",
    "joint": "error over the floor of calibrations, in simulated labs",
    "contradictions": "inputs that contradict the measurements: named, true error, coverage",
    "hall": "joint calibration of halls of 3 to 24 cameras: error, time, memory",
    "tracks": "error of the tracks of driving robots, in simulated labs",
    "track_cost": "time of a message with the positions of 20 robots",
    "dashboard": "share of a core for the dashboard of ipsys live, with one page and ten",
}


@dataclass(slots=True)
class Report:
    """The results of a benchmark: rows for the table, separate tables, remarks; ``details`` for the file.

    A benchmark that ``failed`` has not measured all values.
    """

    name: str
    rows: list[Row] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    failed: bool = False


def _table(reports: list[Report], smoke: bool) -> str:
    lines = [f"{'':<40}{'median':>9} {'min':>7} {'max':>7}  wanted"]
    for report in reports:
        lines.append(report.name)
        for row in report.rows:
            low, high = min(row.values), max(row.values)
            line = f"  {_name(row):<38}{_short(row.median):>9} {_short(low):>7} {_short(high):>7}"
            if row.wanted and not smoke:
                line += f" {row.wanted[0]} {row.wanted[1]:<4g} {'' if row.met else 'MISSED'}"
            lines.append(line.rstrip())
    for report in reports:
        for table in report.tables:
            lines += ["", table]
        lines += ["", *(f"{report.name}: {remark}" for remark in report.remarks)] if report.remarks else []
    if smoke:
        lines += ["", "on next to nothing: these figures mean nothing"]
    return "\n".join(lines)


def _name(row: Row) -> str:
    return f"{row.name}, {row.unit}" if row.unit else row.name


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"


def _as_json(reports: list[Report], machine: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    return {
        "ratios": {r.name: {row.name: row.as_json() for row in r.rows if not row.unit} for r in reports},
        "figures": {r.name: {row.name: row.as_json() for row in r.rows if row.unit} for r in reports},
        "details": {r.name: r.details for r in reports},
        "remarks": {r.name: r.remarks for r in reports if r.remarks},
        "options": {name: value for name, value in vars(options).items() if name != "output"},
        "machine": machine,
    }


def run_all(names: list[str], options: argparse.Namespace, output: Path | None) -> None:
    """Run benchmarks, print their results, and write them to ``output``."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    reports, machine = [], facts()
    if options.smoke:
        options.rounds = 1
    for name in names:
        begin = time.perf_counter()
        print(f"{name}: {BENCHMARKS[name]} ...", end=" ", file=sys.stderr, flush=True)
        reports.append(_measure(name, options))
        print(f"{time.perf_counter() - begin:.0f} s", file=sys.stderr)
    machine["load_at_end"] = os.getloadavg()
    print(_table(reports, options.smoke))
    begin_load, end_load = machine["load_at_start"][0], machine["load_at_end"][0]
    print(f"\n{machine['cpu']}, {machine['cores']} cores; load {begin_load:.1f} to {end_load:.1f}", end="; ")
    print(f"{options.rounds} rounds")
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(json.dumps(_as_json(reports, machine, options), indent=2) + "\n", encoding="utf-8")
        print(f"written to {output}")
    if any(report.failed for report in reports):
        raise SystemExit(1)


def _measure(name: str, options: argparse.Namespace) -> Report:
    """Run a benchmark; a failure becomes a remark, because the other benchmarks have results."""
    try:
        report: Report = importlib.import_module(name).measure(options)
        return report
    except SystemExit as stop:
        return Report(name, remarks=[f"gave up: {stop}"], failed=True)


def parser_of(description: str | None, modules: list[ModuleType]) -> argparse.ArgumentParser:
    """Return the parser with the options of all benchmarks, and those of each benchmark."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--smoke", action="store_true", help="next to no work: do they run?")
    parser.add_argument("--other", metavar="FOLDER", help="checkout to compare with")
    for module in modules:
        module.add_options(parser.add_argument_group(module.__name__))
    return parser


def command(name: str) -> None:
    """Run one benchmark as a script."""
    module = importlib.import_module(name)
    parser = parser_of(module.__doc__, [module])
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()
    run_all([name], options, options.output)
