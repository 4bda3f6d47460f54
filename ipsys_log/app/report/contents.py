"""The contents of a log: cameras, channels, rates, gaps, runs and stationary intervals."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import asdict, replace
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

from rich.text import Text

from ipsys_log.app.report.rows import Rows, mm, name_cell, percent
from ipsys_log.engine.provenance import channel_times, newest_run
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, Run
from ipsys_log.messages.channels import POSITIONS, RUN_EVENTS
from ipsys_log.messages.events import CONTRADICTIONS
from ipsys_log.plain_text import plain_text
from ipsys_log.statistics.disagreement import read_disagreement, reference_ids
from ipsys_log.tools.recording import FrameGaps, find_gaps
from ipsys_log.units import NS_PER_S, format_bytes, format_time
from ipsys_log.vision.lenses import calibration_remarks, check_calibration

if TYPE_CHECKING:
    from ipsys_log.live_runs.survey.from_log import FinishedLog


def intervals_json(scene: FinishedLog) -> list[dict[str, Any]]:
    """Return the stationary intervals of a log as plain data; ``time_s`` is from the start of the log."""
    from ipsys_log.statistics.calibration_points import active_measurements

    active = active_measurements(scene.history())
    return [
        {
            "place": number,
            "marker": stop.marker_id,
            "time_s": round((stop.start_ns - scene.start_ns) / NS_PER_S, 3),
            "start": format_time(stop.start_ns),
            "duration_s": round((stop.end_ns - stop.start_ns) / NS_PER_S, 3),
            "cameras": list(stop.cameras),
            "measured": [m.id for m in active if stop.covers(m)],
        }
        for number, stop in enumerate(scene.intervals, 1)
    ]


def intervals_table(found: list[dict[str, Any]]) -> Rows:
    """Return the stationary intervals of :func:`intervals_json` as a table."""
    columns = (">place", ">marker", ">time s", "UTC", ">for s", "seen by", "measured as")
    cells = [
        [
            str(row["place"]), str(row["marker"]), f"{row['time_s']:.1f}", row["start"][11:19],
            f"{row['duration_s']:.1f}", ", ".join(row["cameras"]), ", ".join(row["measured"]) or "-",
        ]
        for row in found
    ]  # fmt: skip
    return Rows("Stationary intervals", columns, cells)


# More cameras than these share one row, and more pairs of cameras than these are not shown.
_MOST_CAMERAS, _MOST_PAIRS = 6, 10
# The record of an import has more parameters; JSON has all.
_MOST_PARAMETERS = 8
# A camera with a smaller share of the usual number of messages has its own row.
_USUAL_SHARE = 0.95
# Messages of several cameras have no regular interval. On their channels, a gap is longer than this time.
_MERGED_GAP_S = 0.5
# Schemas with one message per frame; the other channels have no rate.
_OF_FRAMES = (
    *("Image", "CompressedImage", "CompressedVideo", "Markers", "ImageAnnotations", "CameraPoints"),
    *("Positions", "Tracks", "FrameTransforms"),
)


def contents_json(session: Session) -> dict[str, Any]:
    """Return the contents of one or several logs as plain data; times in s, sizes in bytes."""
    topics = sorted({topic for reader in session.readers for topic in reader.channels})
    start_ns, end_ns = session.start_ns, session.end_ns
    empty = not any(reader.message_count for reader in session.readers)
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
        "start": None if empty else format_time(start_ns),
        "end": None if empty else format_time(end_ns),
        "duration_s": (end_ns - start_ns) / NS_PER_S,
        "cameras": {
            camera: {
                "images": topic,
                "calibration": session.calibrations.get(camera),
                "lens": _lens(session, camera),
            }
            for camera, topic in session.images.items()
        },
        "calibration_remarks": _calibration_remarks(session),
        "channels": {topic: _channel(session, topic) for topic in topics},
        "contradictions": _contradictions(session),
        "overlap": overlap_json(session),
        "runs": runs_json(session),
    }


def _calibration_remarks(session: Session) -> list[dict[str, str]]:
    """Return remarks on the calibrations of a log: an assumed lens model, and values that no camera has."""
    remarks = [*session.assumed_models().items()]
    for camera, topic in session.calibrations.items():
        lens = replace(_newest(session, topic), frame_id=camera)
        try:
            check_calibration(lens, "its calibration")
            remarks += [(camera, text) for text in calibration_remarks(lens)]
        except IpsysError as error:
            remarks.append((camera, str(error)))
    return [{"camera": camera, "text": text} for camera, text in remarks]


def _contradictions(session: Session) -> list[dict[str, str]]:
    """Return the events of runs about contradicted inputs, each text once."""
    runs = {topic: run for run in session.run_names() for topic in session.topics(RUN_EVENTS, run)}
    texts: dict[str, str] = {}
    for message in session.messages(list(runs)):
        if message.payload.kind in CONTRADICTIONS:
            texts.setdefault(message.payload.text, runs[message.topic])
    return [{"run": run, "text": text} for text, run in texts.items()]


def overlap_json(session: Session) -> list[dict[str, Any]]:
    """Return the disagreement of pairs of cameras in the newest run with positions, as plain data in m."""
    run = newest_run(session, POSITIONS)
    return [
        {
            "run": run,
            "cameras": list(pair.cameras),
            "count": len(pair.times_ns),
            "median_m": pair.median_m,
            "p95_m": pair.p95_m,
            "within_95": pair.within_95,
        }
        for pair in (read_disagreement(session, run, reference_ids(session)) if run else ())
    ]


def _lens(session: Session, camera: str) -> dict[str, Any] | None:
    if camera not in session.calibrations:
        return None
    lens = _newest(session, session.calibrations[camera])
    return {"width": lens.width, "height": lens.height, "model": lens.distortion_model}


def _newest(session: Session, topic: str) -> CameraCalibration:
    *_, message = session.messages([topic], session.last([topic])[0])
    lens: CameraCalibration = message.payload
    return lens


def _channel(session: Session, topic: str) -> dict[str, Any]:
    readers = [reader for reader in session.readers if topic in reader.channels]
    times_ns = channel_times(session, topic)
    schema = readers[0].channels[topic].schema
    name = schema.name if schema else None
    gaps = FrameGaps()
    if name is not None and re.split(r"[./]", name)[-1] in _OF_FRAMES:
        of_one = camera_of_topic(topic) is not None or topic in session.images.values()
        gaps = find_gaps(times_ns, None if of_one else _MERGED_GAP_S)
    return {
        "schema": name,
        "messages": len(times_ns),
        "rate_hz": gaps.rate_hz,
        "gaps": len(gaps.lengths_s),
        "longest_gap_s": max(gaps.lengths_s, default=None),
    }


def states_json(session: Session) -> list[dict[str, Any]]:
    """Return the rows of :func:`runs_json`, each with its state and the version of its stage."""
    from ipsys_log.engine.states import recorded_stages  # imports all stages

    states = [
        {"state": stage.state, "stage_version": stage.stage_version, "out_of_date": stage.out_of_date}
        for stage in recorded_stages(session)
    ]
    return [row | state for row, state in zip(runs_json(session), states, strict=True)]


def runs_json(session: Session) -> list[dict[str, Any]]:
    """Return the runs of a log, one row per stage, as plain data."""
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


def contents_tables(found: dict[str, Any]) -> list[Rows]:
    """Return the contents of :func:`contents_json` as tables, in 80 columns if the names are short enough."""
    files = [
        [file["path"], format_bytes(file["bytes"]), str(file["messages"]), str(file["chunks"])]
        for file in found["files"]
    ]
    span = f"{found['start']} UTC, {found['duration_s']:.1f} s" if found["start"] else "no messages"
    tables = [Rows("Files", ("path", ">size", ">messages", ">chunks"), files, span)]
    tables += [_cameras_table(found)] if found["cameras"] else []
    tables.append(_channels_table(found))
    for title, name, key in (
        ("Remarks on calibrations", "camera", "calibration_remarks"),
        ("Contradicted inputs", "run", "contradictions"),
    ):
        remarks = [[row[name], Text(plain_text(row["text"]), style="yellow")] for row in found[key]]
        tables += [Rows(title, (name, "remark"), remarks)] if remarks else []
    tables += [_overlap_table(found["overlap"])] if found["overlap"] else []
    return [*tables, runs_table(found["runs"])] if found["runs"] else tables


def _cameras_table(found: dict[str, Any]) -> Rows:
    cells = []
    for camera, row in found["cameras"].items():
        channel, lens = found["channels"][row["images"]], row["lens"]
        text = Text("missing", style="yellow")
        if lens is not None:
            text = name_cell(f"{lens['width']} x {lens['height']} px, {lens['model']}")
        cells.append([camera, str(channel["messages"]), _rate(channel), text])
    return Rows("Cameras", ("camera", ">frames", ">Hz", "calibration"), cells)


def _overlap_table(rows: list[dict[str, Any]]) -> Rows:
    """Return a table of the difference of positions of the same robot and instant, by two cameras."""
    columns = ("cameras", ">count", ">median mm", ">p95 mm", ">in 95 % region")
    largest = sorted(rows, key=lambda row: -float(row["median_m"]))[:_MOST_PAIRS]
    cells = [
        [
            " and ".join(row["cameras"]), str(row["count"]), mm(row["median_m"]), mm(row["p95_m"]),
            percent(row["within_95"]),
        ]
        for row in rows
        if row in largest
    ]  # fmt: skip
    others = len(rows) - len(largest)
    note = f"The other {others} pairs differ less. All pairs: --json" if others else ""
    return Rows(f"Disagreement of cameras, run {rows[0]['run']}", columns, cells, note)


def _channels_table(found: dict[str, Any]) -> Rows:
    """Return a table with one row per channel; below the name of a run, its channels have short names."""
    run = ""
    channels = _grouped(found["channels"])
    cells: list[list[str | Text]] = []
    for topic, row in channels.items():
        within, _, rest = topic.removeprefix("/runs/").partition("/")
        if topic.startswith("/runs/") and rest:
            if within != run:
                run = within
                cells.append([Text(plain_text(f"/runs/{run}/"), style="bold")])
            topic = f"  {rest}"  # noqa: PLW2901
        gaps = f"{row['gaps']} ({row['longest_gap_s']:.1f} s)" if row["gaps"] else ""
        schema = re.split(r"[./]", row["schema"] or "-")[-1]
        cells.append([topic, row.get("count") or str(row["messages"]), _rate(row), gaps, schema])
    has_groups = len(channels) < len(found["channels"])
    note = "*: all cameras, with their mean rate and the sum of gaps; each one: --json" if has_groups else ""
    return Rows("Channels", ("topic", ">count", ">Hz", ">gaps (longest)", "schema"), cells, note)


def _grouped(channels: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the channels with one row for equal channels of many cameras; ``count`` is its text."""
    groups: dict[str, dict[str, dict[str, Any]]] = defaultdict(dict)
    for topic, row in channels.items():
        camera = camera_of_topic(topic)
        name = topic if camera is None else topic.replace(f"/cameras/{camera}/", "/cameras/*/")
        groups[name][topic] = row
    rows: dict[str, dict[str, Any]] = {}
    for name, group in groups.items():
        if len(group) <= _MOST_CAMERAS:
            rows |= group
        else:
            rows[name] = _together(group)
            rows |= {topic: row for topic, row in group.items() if _is_unusual(row, group)}
    return rows


def _together(group: dict[str, dict[str, Any]]) -> dict[str, Any]:
    counts = [int(row["messages"]) for row in group.values()]
    rates_hz = [row["rate_hz"] for row in group.values() if row["rate_hz"] is not None]
    low, high = min(counts), max(counts)
    return {
        "schema": next(iter(group.values()))["schema"],
        "count": f"{len(group)} x {low}" if low == high else f"{len(group)} x {low}-{high}",
        "rate_hz": fmean(rates_hz) if rates_hz else None,
        "gaps": sum(row["gaps"] for row in group.values()),
        "longest_gap_s": max((row["longest_gap_s"] or 0.0 for row in group.values()), default=0.0),
    }


def _is_unusual(row: dict[str, Any], group: dict[str, dict[str, Any]]) -> bool:
    usual, usual_gaps = (median(other[key] for other in group.values()) for key in ("messages", "gaps"))
    return bool(row["messages"] < _USUAL_SHARE * usual or row["gaps"] > usual_gaps)


def _rate(channel: dict[str, Any]) -> str:
    return "" if channel["rate_hz"] is None else f"{channel['rate_hz']:.1f}"


def runs_table(runs: list[dict[str, Any]]) -> Rows:
    """Return a table with one row per stage of a run, with its state if the state is known."""
    states = ["state"] if any("state" in run for run in runs) else []
    cells = []
    for run in runs:
        parameters = [f"{key}={value}" for key, value in run["parameters"].items()]
        parameters += [f"other {name}" for name in run["overrides"]]
        if len(parameters) > _MOST_PARAMETERS:
            parameters[_MOST_PARAMETERS:] = [f"{len(parameters) - _MOST_PARAMETERS} more"]
        count = sum(output["messages"] for output in run["outputs"])
        names = (run["run"], run["stage"], ", ".join(run["input_runs"]) or "-", ", ".join(parameters) or "-")
        version = run["fingerprint"].get("ipsys_log", "-")
        cells.append([*names, str(count), version, *([run["state"]] if states else [])])
    columns = ("run", "stage", "from", "parameters", ">count", "ipsys", *states)
    return Rows("Runs", columns, cells)
