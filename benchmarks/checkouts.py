"""Speed of this checkout compared with another one: detection, replay, and replay of detected markers.

    python benchmarks/checkouts.py --other ../before --rounds 5

Both take turns over the same logs, each in a process of its own. The ratios are processor time of the other
checkout divided by that of this one, which other programs disturb little: 1.05 means that this one needs 5 %
less time.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from results import Report, command
from rounds import Contender, Turn, race, ratio_row

__all__ = ["measure"]

_ROOT = Path(__file__).resolve().parent.parent
_WANTED = (">=", 0.95)


def _replay(package: Path, log: Path, until: str | None) -> Turn:
    """Return a turn that replays a log with the package in a folder."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "ipsys_log"]:
        del sys.modules[name]
    sys.path.insert(0, str(package))
    from ipsys_log import __file__ as found
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.pipeline import replay

    assert Path(found).is_relative_to(package), found

    def turn(_number: int) -> None:
        source = package / log  # an absolute path is its own
        with tempfile.TemporaryDirectory() as folder:
            replay([source], Request(("rigid",)), until, output=Path(folder) / "replayed.mcap", jobs=1)

    return turn


def measure(options: argparse.Namespace) -> Report:
    """Replay the same logs with both checkouts."""
    from scenes import drawn

    from ipsys_log.capture.simulation.settings import LabSettings

    images = drawn(LabSettings(stations=6, drive_s=0.2 if options.smoke else 3.0))
    works = {
        "detection": (images, "detect"),
        "replay": (images, None),
        # Its detection has a version, so each checkout has its own.
        "replay of markers": (Path("sample_logs", "paper_lab.mcap"), None),
    }
    report = Report("checkouts")
    for name, work in works.items():
        contenders = [
            Contender(who, _replay, (package.resolve(), *work))
            for who, package in (("this", _ROOT), ("other", Path(options.other or _ROOT)))
        ]
        # The first turn also loads modules and the log.
        timings = race(contenders, 2, options.rounds)
        report.rows.append(ratio_row(f"{name}: other / this", timings["other"], timings["this"], _WANTED))
    return report


def add_options(_parser: argparse._ArgumentGroup) -> None:
    """Add no options."""


if __name__ == "__main__":
    command("checkouts")
