"""The report of a session as one self-contained HTML page: no network, no scripts, no fonts, no clock."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.axes import Axes

from ipsys_log.app.report import html_figures, html_sections
from ipsys_log.app.report.accuracy import Accuracy, read_trajectories
from ipsys_log.app.report.comparison import comparison_lines, comparison_table
from ipsys_log.app.report.comparison_figures import comparison_pictures
from ipsys_log.app.report.contents import runs_table, states_json
from ipsys_log.app.report.figures import MOST_IN_LEGEND, new_figure, style_axes
from ipsys_log.app.report.findings import Findings, gather_findings
from ipsys_log.app.report.html_figures import picture
from ipsys_log.app.report.latency_figure import draw_shares, draw_steps
from ipsys_log.app.report.log_texts import latency_table
from ipsys_log.app.report.rows import Rows
from ipsys_log.app.report.styles import camera_styles, shorten
from ipsys_log.app.report.tables import advice_table, height_note, suspects_table, trajectory_table
from ipsys_log.engine.graph import stages_until, writer_of, writes
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import has_corners
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Run
from ipsys_log.messages.channels import EVALUATION, LATENCY, MEASUREMENTS, POSITIONS, TRACKS
from ipsys_log.models.table import CORNER_MODELS, MODELS
from ipsys_log.plain_text import plain_text, shell_words
from ipsys_log.statistics.calibration_points import measured
from ipsys_log.statistics.cross_validation import FOLDS, REPEATS, SUBSETS
from ipsys_log.statistics.disagreement import read_disagreement, reference_ids
from ipsys_log.statistics.latency import latency_percentiles, step_times_s
from ipsys_log.statistics.tape import RiggedMeasurement
from ipsys_log.tools.comparison import read_comparisons
from ipsys_log.tools.recording import CameraRecording, EventGroup, group_events, read_cameras
from ipsys_log.units import NS_PER_S, format_bytes, format_duration, format_time

# Number of gaps in the table; the figure shows all of them.
_MOST_GAPS = 8
_MS_PER_S = 1e3


def render_report(session: Session, accuracies: Sequence[Accuracy]) -> str:
    """Render the page of a session; the same log always gives the same page."""
    findings = gather_findings(session, accuracies)
    if not findings.cameras and session.topics(MEASUREMENTS):
        raise IpsysError(
            f"{session}: no model was evaluated, because no calibration point is held "
            "out; measure more points"
        )
    return render_page(
        "session.html",
        **_text_values(findings),
        flat=html_sections.weak_points_table(_measured(session, findings)),
        **_figure_values(findings),
        **_overlap(session, findings),
        **_tracks(session),
        **_estimates(session, findings),
        **_recording_values(session),
        **_provenance(session, findings),
        commands=_commands(session, findings),
        most_cameras=MOST_IN_LEGEND,
    )


def render_page(template: str, **values: Any) -> str:
    """Return the page of a template; all texts are escaped, because names in a log may hold any text."""
    environment = Environment(
        loader=PackageLoader("ipsys_log", "app/report"),
        autoescape=True,
        finalize=_plain,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)


def _recording_values(session: Session) -> dict[str, Any]:
    """Return the values of the templates on the recording of a session."""
    cameras, events = read_cameras(session), group_events(session)
    start_ns = session.start_ns
    return {
        "duration": format_duration((session.end_ns - start_ns) / NS_PER_S),
        "sizes": [(reader.path.name, format_bytes(reader.size)) for reader in session.readers],
        "cameras": _cameras_table(session, cameras),
        "gaps": _gaps_table(cameras, start_ns),
        "gap_count": sum(len(camera.gaps.lengths_s) for camera in cameras),
        "events": _events_table(events, start_ns),
        "timeline_pictures": _timeline(session, cameras, events),
        **_latency(session),
    }


def _plain(value: Any) -> Any:
    """Return the displayed form of a value: text without control characters, our own HTML unchanged."""
    if not isinstance(value, str) or hasattr(value, "__html__"):
        return value
    return plain_text(value, keep="\n", longest=len(value))


def _text_values(findings: Findings) -> dict[str, Any]:
    advice = findings.advice
    return {
        "head": html_sections.headline(findings) if findings.cameras else None,
        "advice": advice,
        "advice_table": advice_table(advice) if advice else None,
        "models": html_sections.models_table(findings),
        "by_camera": [(camera, html_sections.models_table(findings, camera)) for camera in findings.cameras],
        "told_note": height_note(findings.models),
        "suspects": suspects_table(findings.accuracies, is_wide=True),
        "coverage": html_sections.coverage(findings),
        "calibration": html_sections.calibration_table(findings),
    }


def _measured(session: Session, findings: Findings) -> list[RiggedMeasurement]:
    """Return the valid measured points, with the rig of the evaluation's options, or with the log's rig."""
    runs = [accuracy.run for accuracy in findings.accuracies]
    rigs = [record.rig for record in session.runs() if record.run in runs and record.rig is not None]
    return measured(LogView(session, rig=rigs[-1] if rigs else None))


def _figure_values(findings: Findings) -> dict[str, Any]:
    return {
        "models_pictures": html_figures.models_pictures(findings),
        "residual_pictures": html_figures.residual_pictures(findings),
        "learning_pictures": html_figures.learning_pictures(findings),
        "published_pictures": html_figures.published_pictures(findings),
        "joint_pictures": html_figures.joint_pictures(findings),
        "other_residual_pictures": html_figures.other_residual_pictures(findings),
        "coverage_picture": html_figures.coverage_picture(findings),
    }


def _overlap(session: Session, findings: Findings) -> dict[str, Any]:
    """Return the disagreement of the cameras in the newest run with positions; empty without an overlap."""
    run = newest_run(session, POSITIONS)
    pairs = read_disagreement(session, run, reference_ids(session)) if run else []
    return {
        "overlap": {"run": run, **html_sections.overlap_tables(pairs)} if pairs else None,
        "overlap_pictures": html_figures.overlap_pictures(pairs, findings.rig) if pairs else [],
    }


def _tracks(session: Session) -> dict[str, Any]:
    """Return the picture of the newest tracks, and their errors if there is ground truth."""
    run = newest_run(session, TRACKS)
    tracks = [] if run is None else [Accuracy(run, None, None, tuple(read_trajectories(session, run)))]
    return {
        "tracks_picture": html_figures.tracks_picture(session, run),
        "trajectories": trajectory_table(tracks),
    }


def _estimates(session: Session, findings: Findings) -> dict[str, Any]:
    """Return the comparisons of estimates with tracks that the log stores; empty if it has no such tracks."""
    try:
        found = read_comparisons(session)
    except IpsysError:  # a pack keeps the estimates, but not the tracks before they are computed again
        found = []
    return {
        "estimates": [(comparison_table(one), [*comparison_lines(one)]) for one in found],
        "estimates_pictures": comparison_pictures(found, findings.rig) if found else [],
    }


def _commands(session: Session, findings: Findings) -> dict[str, str]:
    """Return the commands that print or draw the content of the sections, by name."""
    logs = shell_words(*(path.name for path in session.paths))
    usual = {*MODELS, *(CORNER_MODELS if has_corners(session) else ())}
    named = () if usual == {*findings.models} else findings.models
    models = "".join(f" --model {shell_words(model)}" for model in named)
    return {
        "report": f"ipsys report {logs}",
        "errors": f"ipsys evaluate {logs}{models} --details",
        "plots": f"ipsys evaluate {logs}{models} --plot figures",
        "tracks": f"ipsys view {logs}",
        "compare": f"ipsys compare {logs}",
        "info": f"ipsys info {logs}",
        "check": f"ipsys check {logs} --details",
        "latency": f"ipsys info --latency {logs} --plot latency.png",
        "runs": f"ipsys info --runs {logs}",
    }


def _provenance(session: Session, findings: Findings) -> dict[str, Any]:
    """Return the provenance of the page: logs, runs and parameters."""
    records = session.runs()
    runs = (
        _sources(records, [accuracy.run for accuracy in findings.accuracies])
        if findings.accuracies
        else records
    )
    names = {(run.run, run.stage) for run in runs}
    newest = next((run for run in reversed(runs) if writes(run, EVALUATION)), runs[-1] if runs else None)
    return {
        "logs": [path.name for path in session.paths],
        "lab": findings.rig.name if findings.rig else "",
        "recorded": _span(format_time(session.start_ns)[:16], format_time(session.end_ns)[:16]),
        "runs": runs_table([row for row in states_json(session) if (row["run"], row["stage"]) in names]),
        "fingerprint": dict(sorted(newest.fingerprint.items())) if newest else {},
        "folds": FOLDS,
        "repeats": REPEATS,
        "subsets": SUBSETS,
    }


def _span(start: str, end: str) -> str:
    """Format two times; the second one has a date only if the dates differ."""
    same_day = start[:10] == end[:10]
    return f"{start} to {end[11:] if same_day else end} UTC"


def _sources(records: Sequence[Run], names: Sequence[str]) -> list[Run]:
    """Return the records of some runs up to their evaluation, and the records of all their input runs."""
    collected: set[str] = set()
    waiting = [*names]
    while waiting:
        name = waiting.pop()
        if name not in collected:
            collected.add(name)
            waiting += [source for record in records if record.run == name for source in record.input_runs]
    earlier = stages_until(writer_of(EVALUATION).name)
    later = {stage.name for stage in stages_until(None) if stage not in earlier}
    return [record for record in records if record.run in collected and record.stage not in later]


def _cameras_table(session: Session, cameras: Sequence[CameraRecording]) -> Rows:
    columns = ("camera", ">frames", ">rate in Hz", ">gaps", ">length of all gaps in s", "intrinsics")
    cells = []
    for one in cameras:
        rate_hz, lengths_s = one.gaps.rate_hz, one.gaps.lengths_s
        rate = "-" if rate_hz is None else f"{rate_hz:.1f}"
        missing = f"{sum(lengths_s):.1f}" if lengths_s else "0"
        numbers = (str(one.frames), rate, str(len(lengths_s)), missing)
        cells.append([one.camera, *numbers, _size(session, one.camera)])
    return Rows("", columns, cells)


def _size(session: Session, camera: str) -> str:
    if camera not in session.calibrations:
        return "missing"
    lens = session.payloads([session.calibrations[camera]])[-1]
    return f"{lens.width} x {lens.height} px, {lens.distortion_model}"


def _gaps_table(cameras: Sequence[CameraRecording], start_ns: int) -> Rows:
    """Return the longest gaps of all cameras."""
    gaps = [
        (length_s, camera.camera, (begin_ns - start_ns) / NS_PER_S)
        for camera in cameras
        for begin_ns, length_s in zip(camera.gaps.starts_ns, camera.gaps.lengths_s, strict=True)
    ]
    longest = sorted(gaps, key=lambda gap: (-gap[0], gap[2]))[:_MOST_GAPS]
    cells = [(camera, f"{begin_s:.1f}", f"{length_s:.2f}") for length_s, camera, begin_s in longest]
    return Rows("", ("gap of camera", ">start in s", ">length in s"), cells)


def _events_table(events: Sequence[EventGroup], start_ns: int) -> Rows:
    columns = ("event", "camera", "run", ">count", ">first in s", ">last in s", "last text")
    cells = []
    for group in events:
        ends = (f"{(group.times_ns[end] - start_ns) / NS_PER_S:.1f}" for end in (0, -1))
        names = (group.kind, group.camera or "-", group.run or "-")
        cells.append((*names, str(len(group.times_ns)), *ends, group.text))
    return Rows("", columns, cells)


def _timeline(
    session: Session, cameras: Sequence[CameraRecording], events: Sequence[EventGroup]
) -> list[dict[str, Any]]:
    """Return the figure of the recorded times of the cameras, with their gaps and events."""
    if not cameras:
        return []
    figure, axes = new_figure(1.1 + 0.34 * (len(cameras) + 1))
    styles = camera_styles([camera.camera for camera in cameras])
    for row, camera in enumerate(cameras):
        _draw_recorded(axes, row, camera, session.start_ns, styles[camera.camera][0])
    marks = [(time_ns, group.camera) for group in events if group.run is None for time_ns in group.times_ns]
    rows = {camera.camera: row for row, camera in enumerate(cameras)}
    if marks:
        times_s = [(time_ns - session.start_ns) / NS_PER_S for time_ns, _ in marks]
        places = [rows.get(camera or "", len(cameras)) for _, camera in marks]
        axes.plot(times_s, places, "|", color="black", ms=11, mew=1.2)
    names = [shorten(camera.camera) for camera in cameras]
    axes.set_yticks(range(len(cameras) + 1), [*names, "all"])
    axes.set_ylim(len(cameras) + 0.6, -0.6)
    axes.set_xlim(0, max((session.end_ns - session.start_ns) / NS_PER_S, 1e-3))
    axes.set_xlabel("time in s")
    style_axes(axes, "x")
    caption = "Recorded frames of each camera. White: gaps. Black lines: events of the recording"
    return [picture(figure, caption)]


def _draw_recorded(axes: Axes, row: int, camera: CameraRecording, start_ns: int, colour: str) -> None:
    gaps = zip(camera.gaps.starts_ns, camera.gaps.lengths_s, strict=True)
    begins_ns = [camera.start_ns, *(gap_ns + round(length_s * NS_PER_S) for gap_ns, length_s in gaps)]
    ends_ns = [*camera.gaps.starts_ns, camera.end_ns]
    bars_s = [
        ((begin_ns - start_ns) / NS_PER_S, (end_ns - begin_ns) / NS_PER_S)
        for begin_ns, end_ns in zip(begins_ns, ends_ns, strict=True)
    ]
    # The edge keeps a single frame visible, whose bar has no width.
    axes.broken_barh(bars_s, (row - 0.25, 0.5), fc=colour, ec=colour, lw=1.0)


def _latency(session: Session) -> dict[str, Any]:
    """Return the table and the figures of the latency; empty for a session without live positions."""
    entries = session.payloads(session.topics(LATENCY))
    times_s = step_times_s(entries) if entries else {}
    if not entries:
        return {"latency": None, "latency_count": 0, "latency_pictures": []}
    shares, axes = new_figure(3.4)
    draw_shares(axes, np.sort(times_s["total"]) * _MS_PER_S, is_narrow=True)
    steps, step_axes = new_figure(3.4)
    draw_steps(step_axes, times_s)
    return {
        "latency": latency_table(latency_percentiles(times_s)),
        "latency_count": len(entries),
        "latency_pictures": [
            picture(shares, "Share of the positions within a latency, from the arrival of a frame"),
            picture(steps, "Duration of each step: median and 99th percentile"),
        ],
    }
