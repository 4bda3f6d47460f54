"""What a log holds: cameras, channels, rates, gaps and runs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from rich.table import Table

from ipsys_log.log.session import Session
from ipsys_log.messages import Run
from ipsys_log.units import NS_PER_S, format_bytes, format_time

__all__ = ["contents_json", "contents_tables", "runs_json", "runs_table"]

# A gap is a silence of this many times the usual distance between messages.
_GAP_FACTOR = 3
_INSTANT_S = 1e-4


def contents_json(session: Session) -> dict[str, Any]:
    """The contents of one or several logs as plain data; times in s, sizes in bytes."""
    topics = sorted({topic for reader in session.readers for topic in reader.channels})
    start_ns, end_ns = session.start_ns, session.end_ns
    return {
        "files": [
            {
                "path": str(reader.path),
                "bytes": reader.size,
                "messages": reader.message_count,
                "chunks": reader.chunk_count,
                "compression": {name or "none": count for name, count in reader.compressions.items()},
            }
            for reader in session.readers
        ],
        "start": format_time(start_ns),
        "end": format_time(end_ns),
        "duration_s": (end_ns - start_ns) / NS_PER_S,
        "cameras": {
            camera: {"images": topic, "calibration": session.calibrations.get(camera)}
            for camera, topic in session.images.items()
        },
        "channels": {topic: _channel(session, topic) for topic in topics},
        "runs": runs_json(session),
    }


def _channel(session: Session, topic: str) -> dict[str, Any]:
    readers = [reader for reader in session.readers if topic in reader.channels]
    times_ns = np.sort(np.concatenate([reader.times(topic) for reader in readers]))
    steps_s = np.diff(times_ns) / NS_PER_S
    # What is written at one instant, such as the measurements of one place, has no rate.
    apart_s = steps_s[steps_s > _INSTANT_S]
    usual_s = float(np.median(apart_s)) if len(apart_s) else 0.0
    gaps = apart_s[apart_s > _GAP_FACTOR * usual_s]
    schema = readers[0].channels[topic].schema
    return {
        "schema": schema.name if schema else None,
        "messages": len(times_ns),
        "rate_hz": 1 / usual_s if usual_s > 0 else None,
        "gaps": len(gaps),
        "longest_gap_s": float(gaps.max()) if len(gaps) else None,
    }


def runs_json(session: Session) -> list[dict[str, Any]]:
    """The runs of a log, one row per stage, as plain data."""
    return [
        {
            "run": run.run,
            "stage": run.stage,
            "parameters": run.parameters,
            "input_runs": list(run.input_runs),
            "overrides": _overrides(run),
            "rig": None if run.rig is None else asdict(run.rig),
            "inputs": [{"topic": i.topic, "messages": i.messages, "hash": i.hash} for i in run.inputs],
            "outputs": [{"topic": o.topic, "messages": o.messages} for o in run.outputs],
            "fingerprint": run.fingerprint,
        }
        for run in session.runs()
    ]


def _overrides(run: Run) -> list[str]:
    rig = [] if run.rig is None else [f"rig ({run.rig.name}, {run.rig.marker_length_m:g} m)"]
    return [*rig, *(f"lens {lens.camera}" for lens in run.lenses)]


def _table(title: str, *columns: str, right: tuple[str, ...] = ()) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", overflow="fold")
    return table


def contents_tables(found: dict[str, Any]) -> list[Table]:
    """The same as tables of at most 80 columns."""
    files = _table("Files", "path", "size", "messages", "chunks", right=("size", "messages", "chunks"))
    for file in found["files"]:
        files.add_row(file["path"], format_bytes(file["bytes"]), str(file["messages"]), str(file["chunks"]))
    files.caption = f"{found['start']} UTC, {found['duration_s']:.1f} s"
    files.caption_justify = "left"
    cameras = _table("Cameras", "camera", "images", "calibration")
    for camera, row in found["cameras"].items():
        cameras.add_row(camera, row["images"], row["calibration"] or "missing")
    numbers = ("count", "Hz", "gaps")
    channels = _table("Channels", "topic", *numbers, "schema", right=numbers)
    for column in channels.columns[1:4]:
        column.no_wrap = True
    channels.columns[0].ratio, channels.columns[4].max_width = 1, 17
    for topic, row in found["channels"].items():
        rate = "-" if row["rate_hz"] is None else f"{row['rate_hz']:.1f}"
        gaps = "-" if not row["gaps"] else f"{row['gaps']}, {row['longest_gap_s']:.1f} s"
        schema = (row["schema"] or "-").rpartition(".")[2]
        channels.add_row(topic, str(row["messages"]), rate, gaps, schema)
    tables = [files, *([cameras] if found["cameras"] else []), channels]
    return [*tables, runs_table(found["runs"])] if found["runs"] else tables


def runs_table(runs: list[dict[str, Any]]) -> Table:
    """One row per stage of a run."""
    table = _table("Runs", "run", "stage", "from", "parameters", "count", "ipsys", right=("count",))
    for run in runs:
        given = [f"{key}={value}" for key, value in run["parameters"].items()]
        given += [f"other {name}" for name in run["overrides"]]
        count = sum(output["messages"] for output in run["outputs"])
        sources = ", ".join(run["input_runs"]) or "-"
        version = run["fingerprint"].get("ipsys_log", "-")
        table.add_row(run["run"], run["stage"], sources, ", ".join(given) or "-", str(count), version)
    return table
