"""Error of the clock of a node at the centre, in simulated exchanges with known offset, drift and jitter.

    python benchmarks/node_clock.py --clocks 1000

The exchanges have the times of the centre, and random delays in each direction, uniform up to 20 ms. Offsets
are up to an hour, drifts up to 100 ppm. Before each exchange, the time of a frame of that instant is
converted, as at the centre. A row is about the greatest error of each clock since the row before: median,
minimum and maximum over all clocks.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Iterator

from results import Report, command
from rounds import Row

from ipsys_log.capture.node_clock import ClockHistory, Exchange
from ipsys_log.capture.nodes.centre import exchange_period_s
from ipsys_log.units import NS_PER_S

__all__ = ["measure"]

_TIMES_S = (0.5, 1.0, 1.5, 2.5, 5.0, 10.0, 20.0, 30.0, 80.0)
_START_NS = 1_700_000_000 * NS_PER_S
_MS = NS_PER_S // 1000
_LEAST_MS, _JITTER_MS, _WORK_NS, _MOST_OFFSET_NS = 0.1, 20, _MS // 10, 3600 * NS_PER_S


def _errors_ms(seed: int, nodes: int) -> Iterator[tuple[float, float]]:
    """Yield the time of each exchange in s, and the error of a frame at this instant in ms."""
    rng, history, at_s = random.Random(seed), ClockHistory(), 0.0
    offset_ns, drift = rng.randint(-_MOST_OFFSET_NS, _MOST_OFFSET_NS), rng.uniform(-100e-6, 100e-6)

    def by_node(ns: int) -> int:
        return ns - offset_ns - round(drift * (ns - _START_NS))

    for number in range(10**6):
        sent_ns = _START_NS + round(at_s * NS_PER_S)
        centre_ns = history.to_centre_ns(by_node(sent_ns))
        if centre_ns is not None:
            yield at_s, abs(centre_ns - sent_ns) / _MS
        there_ns, back_ns = (round((_LEAST_MS + rng.random() * _JITTER_MS) * _MS) for _ in range(2))
        received_ns = sent_ns + there_ns
        replied_ns = received_ns + _WORK_NS
        history.add(Exchange(sent_ns, by_node(received_ns), by_node(replied_ns), replied_ns + back_ns))
        at_s += exchange_period_s(number + 1, nodes)
        if at_s > _TIMES_S[-1]:
            return


def _greatest_ms(seed: int, nodes: int) -> list[float]:
    """Return the greatest error between two times of the table, for each row."""
    greatest = [0.0] * len(_TIMES_S)
    for at_s, error_ms in _errors_ms(seed, nodes):
        row = next(row for row, end_s in enumerate(_TIMES_S) if at_s <= end_s)
        greatest[row] = max(greatest[row], error_ms)
    return greatest


def measure(options: argparse.Namespace) -> Report:
    """Simulate the clocks."""
    report = Report("node_clock")
    clocks = [
        _greatest_ms(seed, options.clock_nodes) for seed in range(3 if options.smoke else options.clocks)
    ]
    for row, end_s in enumerate(_TIMES_S):
        errors_ms = tuple(greatest[row] for greatest in clocks)
        report.rows.append(Row(f"greatest error until {end_s:g} s", errors_ms, "ms"))
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--clocks", type=int, default=1000, help="the number of simulated clocks")
    parser.add_argument("--clock-nodes", type=int, default=1, help="the nodes of the centre")


if __name__ == "__main__":
    command("node_clock")
