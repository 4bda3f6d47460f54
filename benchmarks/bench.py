"""Run the benchmarks and print what they measure: ratios first.

    ./scripts/bench                      # all of them, about a quarter of an hour
    ./scripts/bench detection startup    # some
    ./scripts/bench --smoke              # on next to nothing: that they run, not what they measure

Speed is a ratio within one run: contenders take turns at the same work, each in a process of its own,
round after round; a row is the median over the rounds, the least and the most. Writes one JSON file,
ratios first, then figures with a unit, then everything else, by default .cache/bench/results.json.
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
