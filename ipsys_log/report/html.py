"""The report of a session as one self-contained HTML page: no network, no scripts, no fonts, no clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from ipsys_log.analysis.calibration_points import measured
from ipsys_log.analysis.cross_validation import FOLDS, REPEATS, SUBSETS
from ipsys_log.analysis.disagreement import read_disagreement, reference_ids
from ipsys_log.analysis.tape import RiggedMeasurement
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Run
from ipsys_log.messages.channels import EVALUATION, MEASUREMENTS, POSITIONS, TRACKS
from ipsys_log.models.table import CORNER_MODELS, MODELS
from ipsys_log.plain_text import plain_text, shell_words
from ipsys_log.report import html_figures, html_sections
from ipsys_log.report.accuracy import Accuracy, read_trajectories
from ipsys_log.report.advice import HEIGHT_NOTE, uses_height
from ipsys_log.report.camera_labels import MOST_IN_LEGEND
from ipsys_log.report.findings import Findings, gather_findings
from ipsys_log.report.html_recording import recording_values
from ipsys_log.report.trajectory_table import TRAJECTORY_COLUMNS, rows_of_run
from ipsys_log.runs.graph import stages_until, writer_of, writes
from ipsys_log.runs.provenance import newest_run
from ipsys_log.runs.select import has_corners
from ipsys_log.runs.states import recorded_stages
from ipsys_log.runs.view import LogView
from ipsys_log.units import format_time


def render_report(session: Session, accuracies: Sequence[Accuracy]) -> str:
    """Render the page of a session; the same log always gives the same page.

    Parameters
    ----------
    session : open logs.
    accuracies : from :func:`ipsys_log.report.accuracy.read_accuracy`.

    Raises
    ------
    IpsysError
        The session has calibration points, but no evaluated model.
    """
    findings = gather_findings(session, accuracies)
    if not findings.cameras and session.topics(MEASUREMENTS):
        raise IpsysError(
            f"{session}: no model was evaluated, because no calibration point is held "
            "out; measure more points"
        )
    environment = Environment(
        loader=PackageLoader("ipsys_log", "report"),
        autoescape=True,  # names in a log may hold any text
        finalize=_plain,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("session.html").render(
        **_text_values(findings),
        flat=html_sections.flat_rows(_measured(session, findings)),
        **_figure_values(findings),
        **_overlap(session, findings),
        **_tracks(session),
        **recording_values(session),
        **_provenance(session, findings),
        commands=_commands(session, findings),
        most_cameras=MOST_IN_LEGEND,
    )


def _plain(value: Any) -> Any:
    """Return the displayed form of a value: text without control characters, our own HTML unchanged."""
    if not isinstance(value, str) or hasattr(value, "__html__"):
        return value
    return plain_text(value, keep="\n", longest=len(value))


def _text_values(findings: Findings) -> dict[str, Any]:
    return {
        "head": html_sections.headline(findings) if findings.cameras else None,
        "advice": html_sections.advice_rows(findings),
        "models": html_sections.model_rows(findings),
        "by_camera": [(camera, html_sections.model_rows(findings, camera)) for camera in findings.cameras],
        "told_note": HEIGHT_NOTE if any(map(uses_height, findings.models)) else "",
        "suspects": html_sections.suspects(findings),
        "coverage": html_sections.coverage(findings),
        "calibration": html_sections.calibration(findings),
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
    return {
        "tracks_picture": html_figures.tracks_picture(session, run),
        "trajectories": rows_of_run(run, read_trajectories(session, run)) if run is not None else [],
        "trajectory_columns": TRAJECTORY_COLUMNS,
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
        "plots": f"ipsys evaluate {logs}{models} --plots figures",
        "tracks": f"ipsys view {logs}",
        "info": f"ipsys info {logs}",
        "check": f"ipsys check {logs} --details",
        "latency": f"ipsys latency {logs} --plot latency.png",
        "runs": f"ipsys runs {logs}",
    }


def _provenance(session: Session, findings: Findings) -> dict[str, Any]:
    """Return the provenance of the page: logs, runs and parameters."""
    records = session.runs()
    runs = (
        _sources(records, [accuracy.run for accuracy in findings.accuracies])
        if findings.accuracies
        else records
    )
    newest = next((run for run in reversed(runs) if writes(run, EVALUATION)), runs[-1] if runs else None)
    return {
        "logs": [path.name for path in session.paths],
        "lab": findings.rig.name if findings.rig else "",
        "recorded": _span(format_time(session.start_ns)[:16], format_time(session.end_ns)[:16]),
        "runs": _with_states(session, runs),
        "fingerprint": dict(sorted(newest.fingerprint.items())) if newest else {},
        "folds": FOLDS,
        "repeats": REPEATS,
        "subsets": SUBSETS,
    }


def _with_states(session: Session, runs: Sequence[Run]) -> list[tuple[Run, str]]:
    """Return runs, each with its state."""
    states = {(stage.run.run, stage.run.stage): stage.state for stage in recorded_stages(session)}
    return [(run, states.get((run.run, run.stage), "")) for run in runs]


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
