"""Where markers lie still in a log, numbered as a sheet of measurements names them."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from ipsys_log.analysis.pairs import active_measurements
from ipsys_log.survey.from_log import FinishedLog
from ipsys_log.units import NS_PER_S, format_time

__all__ = ["stops_json", "stops_table"]


def stops_json(scene: FinishedLog) -> list[dict[str, Any]]:
    """The places of a log as plain data; ``time_s`` from its start."""
    active = active_measurements(scene.history())
    return [
        {
            "place": number,
            "marker": stop.marker_id,
            "time_s": round((stop.start_ns - scene.start_ns) / NS_PER_S, 3),
            "start": format_time(stop.start_ns),
            "seconds": round((stop.end_ns - stop.start_ns) / NS_PER_S, 3),
            "cameras": list(stop.cameras),
            "measured": [m.id for m in active if stop.covers(m)],
        }
        for number, stop in enumerate(scene.stops, 1)
    ]


def stops_table(found: list[dict[str, Any]]) -> Table:
    """The same to be read."""
    table = Table(
        title="Where markers lie still", title_justify="left", title_style="bold", box=None, pad_edge=False
    )
    for name in ("place", "marker", "time s"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("UTC", no_wrap=True)
    table.add_column("for s", justify="right", no_wrap=True)
    table.add_column("seen by", overflow="fold")
    table.add_column("measured as", overflow="fold")
    for row in found:
        table.add_row(
            str(row["place"]), str(row["marker"]), f"{row['time_s']:.1f}", row["start"][11:19],
            f"{row['seconds']:.1f}", ", ".join(row["cameras"]), ", ".join(row["measured"]) or "-",
        )  # fmt: skip
    return table
