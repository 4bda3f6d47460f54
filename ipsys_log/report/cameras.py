"""Live cameras, latencies and comparisons as tables for a terminal and for JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.table import Table
from rich.text import Text

from ipsys_log.compare import Comparison
from ipsys_log.latency import Percentiles
from ipsys_log.monitor import Look
from ipsys_log.sources.attached import CameraState
from ipsys_log.units import CM_PER_M

__all__ = ["CameraRates", "cameras_table", "comparison_json", "comparison_table", "latency_table"]


class CameraRates:
    """Rates of cameras between one look at their counts and the next."""

    def __init__(self) -> None:
        self._before: dict[str, tuple[float, int, int]] = {}

    def __call__(self, name: str, state: CameraState, now_s: float) -> tuple[float, float]:
        """Frames and MB per second since the last call."""
        then_s, frames, size = self._before.get(name, (now_s, state.frames, state.bytes))
        self._before[name] = now_s, state.frames, state.bytes
        took_s = max(now_s - then_s, 1e-9)
        return (state.frames - frames) / took_s, (state.bytes - size) / took_s / 1e6


def cameras_table(
    states: Mapping[str, CameraState],
    looks: Mapping[str, Look],
    rates: Mapping[str, tuple[float, float]],
    delays_s: Mapping[str, float],
) -> Table:
    """A row for each camera, at most 80 columns wide.

    Parameters
    ----------
    rates : frames and MB per second.
    delays_s : from exposure to arrival, of cameras with capture stamps.
    """
    table = Table(box=None, pad_edge=False)
    for heading in ("camera", "frames", "Hz", "MB/s", "drops", "delay", "light", "sharp", "markers"):
        table.add_column(heading, justify="left" if heading in ("camera", "markers") else "right")
    for name, state in states.items():
        look = looks.get(name)
        rate_hz, mb_s = rates.get(name, (0.0, 0.0))
        delay = f"{1e3 * delays_s[name]:.0f} ms" if name in delays_s else "-"
        table.add_row(
            name if state.up or state.finished else Text(f"{name} (lost)", style="red"),
            str(state.frames),
            f"{rate_hz:.1f}",
            f"{mb_s:.1f}",
            Text(str(state.dropped), style="red" if state.dropped else ""),
            delay,
            f"{look.brightness:.0f}" if look else "-",
            f"{100 * look.sharpness:.0f} %" if look else "-",
            ", ".join(map(str, look.markers)) or "none" if look else "-",
        )
    return table


def latency_table(steps: Mapping[str, Percentiles]) -> Table:
    """How long each step took, in ms."""
    table = Table(box=None, pad_edge=False, title="Milliseconds to each step", title_justify="left")
    table.add_column("step")
    for heading in ("median", "90 %", "99 %", "longest"):
        table.add_column(heading, justify="right")
    for step, found in steps.items():
        table.add_row(step, *(f"{1e3 * value:.1f}" for value in asdict(found).values()))
    return table


def comparison_table(found: Sequence[Comparison]) -> Table:
    """A row for each channel, and what differs first below it."""
    table = Table(box=None, pad_edge=False)
    for heading in ("channel", "left", "right", "same", "RMS", "greatest"):
        table.add_column(heading, justify="left" if heading == "channel" else "right")
    for one in found:
        style = "" if one.equal else "red"
        table.add_row(
            Text(one.topic.removeprefix("/runs/"), style=style),
            str(one.left),
            str(one.right),
            "all" if one.equal else str(one.same),
            _distance(one.rms, one.unit),
            _distance(one.greatest, one.unit),
        )
        if one.first is not None:
            table.add_row(Text(f"  first: {one.first}", style=style))
    return table


def _distance(value: float | None, unit: str | None) -> str:
    if value is None:
        return ""
    if value == 0:
        return "0"
    return f"{value:.2g} px" if unit == "px" else f"{value * CM_PER_M:.2g} cm"


def comparison_json(found: Sequence[Comparison]) -> dict[str, Any]:
    """Whether all is equal, and each channel."""
    return {"equal": all(one.equal for one in found), "channels": [asdict(one) for one in found]}
