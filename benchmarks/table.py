"""Speed of reading a channel as a table, compared with decoding its messages one by one.

    python benchmarks/table.py --rows 1000000

Each message has the tracks of three robots with covariances. ``Log.table("tracks")`` and a loop over
``Log.messages`` read a file in the page cache; in turns, in separate processes.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from results import Report, command
from rounds import Contender, Row, Turn, race, ratio_row
from scenes import CACHE

import ipsys_log as ipsys
from ipsys_log.engine.output import write_log
from ipsys_log.messages import Message, Rig, Track, Tracks

__all__ = ["measure"]

_ROBOTS = 3
_STEP_NS = 10_000_000
_START_NS = 1_700_000_000_000_000_000


def tracks(rows: int) -> Iterator[Message]:
    """Yield tracks of three robots, with covariances that differ."""
    chance = np.random.default_rng(0)
    yield Message("/rig", _START_NS, _START_NS, Rig("lab", "DICT_4X4_100", 0.2))
    for number in range(rows // _ROBOTS):
        time_ns = _START_NS + number * _STEP_NS
        covariance_m2 = np.eye(3) * (1e-4 + 1e-9 * number)
        numbers = chance.normal(size=(_ROBOTS, 4)).tolist()
        poses = tuple(
            Track(f"robot_{n}", n, x_m, y_m, z_m, heading_rad, covariance_m2, ("red", "white"), True)
            for n, (x_m, y_m, z_m, heading_rad) in enumerate(numbers)
        )
        yield Message("/runs/poly/tracks", time_ns, time_ns, Tracks(time_ns, poses))


def _import() -> tuple[object, object]:
    """Import the packages that both need: this takes a second, and is not measured."""
    import pandas as pd

    return ipsys.open, pd.DataFrame


def table(path: Path) -> Turn:
    _import()

    def turn(_number: int) -> tuple[int, float]:
        with ipsys.open(path) as log:
            rows = len(log.table("tracks", run="poly"))
        return rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    return turn


def decoded(path: Path) -> Turn:
    _import()

    def turn(_number: int) -> tuple[int, float]:
        with ipsys.open(path) as log:
            rows = sum(len(message.payload.tracks) for message in log.messages("tracks", run="poly"))
        return rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    return turn


def measure(options: argparse.Namespace) -> Report:
    """Race the table against the decoder."""
    report = Report("table")
    rows = 3_000 if options.smoke else options.rows
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        path = Path(folder) / "tracks.mcap"
        write_log(path, tracks(rows))
        contenders = [Contender("decoded", decoded, (path,)), Contender("table", table, (path,))]
        timings = race(contenders, 1, options.rounds)
    if timings["table"].kept[0][0] != timings["decoded"].kept[0][0]:
        raise SystemExit("the table has other rows than the messages")
    report.rows.append(ratio_row("decoded / table", timings["decoded"], timings["table"]))
    report.rows.append(Row("table, processor time", tuple(timings["table"].cpu_s), "s"))
    report.rows.append(Row("table, most memory", (timings["table"].kept[0][1],), "MB"))
    report.details["rows"] = rows
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--rows", type=int, default=1_000_000, help="of the table")


if __name__ == "__main__":
    command("table")
