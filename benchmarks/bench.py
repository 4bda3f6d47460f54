"""Run the benchmarks and print their results: ratios first.

    ./scripts/bench                      # all benchmarks, about half an hour
    ./scripts/bench detection answers    # some benchmarks
    ./scripts/bench --smoke              # with very little data: a test that they run, not a measurement

Speed is a ratio within one run: contenders take turns at the same work, each in a separate process, round
after round. A row has the median over the rounds, the minimum and the maximum. The command writes one JSON
file: ratios first, then numbers with a unit, then all other values; by default .cache/bench/results.json.
"""

from __future__ import annotations

import importlib
from pathlib import Path

from results import BENCHMARKS, parser_of, run_all
from scenes import CACHE


def main() -> None:
    modules = [importlib.import_module(name) for name in BENCHMARKS]
    parser = parser_of(__doc__, modules)
    parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(BENCHMARKS)}")
    parser.add_argument(
        "-o", "--output", type=Path, default=CACHE / "results.json", help="JSON file to write"
    )
    options = parser.parse_args()
    for name in options.names:
        if name not in BENCHMARKS:
            parser.error(f"no benchmark {name!r}; there are {', '.join(BENCHMARKS)}")
    run_all(options.names or list(BENCHMARKS), options, options.output)


if __name__ == "__main__":
    main()
