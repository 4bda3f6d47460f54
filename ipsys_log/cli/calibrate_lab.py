"""Calibration of a whole lab from drives and a few taped points: ``ipsys calibrate-lab``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from ipsys_log.cli.console import console, progress_bar, remarks
from ipsys_log.cli.options import (
    AsJson,
    Calibrations,
    Corners,
    Force,
    Host,
    Port,
    RigFile,
    cameras_of,
    load_calibrations,
    load_matching_rig,
    log_option,
)
from ipsys_log.cli.stages import derive

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from rich.table import Table

    from ipsys_log.messages import CameraCalibration, Rig
    from ipsys_log.survey.lab_calibration import LabCalibration

__all__ = ["add_commands", "nominal_lenses"]

# Largest goal that still means something, in mm.
_MOST_GOAL_MM = 1000.0
_MOST_FAULTS = 8

Focal = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option(
        "--focal",
        metavar="[CAMERA=]PX",
        help="Nominal focal length in pixels, of one camera, or of all cameras without a calibration. The "
        "fit estimates the intrinsics.",
    ),
]
FieldOfView = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option(
        "--field-of-view",
        metavar="[CAMERA=]DEGREES",
        help="Nominal horizontal field of view, instead of a focal length.",
    ),
]
Goal = Annotated[
    float,
    typer.Option("--goal-mm", metavar="MM", help="Wanted mean error over the floor of each camera, in mm."),
]
Train = Annotated[str, typer.Option(metavar="LABEL", help="Fit on the measurements with this label.")]
Output = Annotated[
    Optional[Path],  # noqa: UP045
    log_option(help="Write the results to a new log, not to the last LOG. Without LOG: the log to record."),
]
Plot = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Draw the expected error over the floor of each camera: .png, .pdf, .svg or .jpg.",
    ),
]


SaveNominal = Annotated[
    Path | None,
    typer.Option(
        "--save-nominal",
        metavar="DIR",
        help="With LOG: write the nominal intrinsics into this folder, such as red.yaml, for lab.toml and "
        "--calibration of later commands.",
    ),
]
Sources = Annotated[
    Optional[list[Path]],  # noqa: UP045
    typer.Argument(
        help="Logs, read as one session. The last log gets the results. Without LOG: use the cameras of "
        "--rig now.",
        metavar="LOG",
    ),
]
Seconds = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option(min=1.0, metavar="SECONDS", help="Without LOG: stop the cameras after this time."),
]
Terminal = Annotated[
    bool,
    typer.Option(
        "--terminal",
        help="Without LOG: ask for the measured points in the terminal after the drive, not on a page.",
    ),
]


def add_commands(app: typer.Typer) -> None:
    app.command("calibrate-lab")(calibrate_lab)


def calibrate_lab(
    logs: Sources = None,
    goal_mm: Goal = 3.0,
    focal: Focal = None,
    field_of_view: FieldOfView = None,
    train: Train = "train",
    rig: RigFile = None,
    calibration: Calibrations = None,
    corners: Corners = None,
    output: Output = None,
    plot: Plot = None,
    save_nominal: SaveNominal = None,
    seconds: Seconds = None,
    terminal: Terminal = False,
    host: Host = None,
    port: Port = 8000,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate all cameras of a lab together, from drives of robots and a few taped points.

    The command fits the model joint, prints the expected error over the floor, and says whether it is enough.
    If it is not, the command names points to tape and a part of the floor to drive through. Without a tape:
    lay a marker on each of two reference points, and enter 0 as its distance.

    Without LOG, the command records the cameras of --rig into -o until Ctrl-C. Meanwhile it prints the
    expected error, and takes the measured points on a page.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.messages.channels import MODEL, RIG
    from ipsys_log.report.files import check_figure_file
    from ipsys_log.runs.graph import writes
    from ipsys_log.sinks.selection import rig_in_force
    from ipsys_log.survey.lab_calibration import describe_lab

    if not 0 < goal_mm <= _MOST_GOAL_MM:
        raise IpsysError(f"--goal-mm {goal_mm:g}: is not a length above 0 and up to {_MOST_GOAL_MM:g} mm")
    if plot is not None:
        check_figure_file(plot, "--plot", logs or [])
    if logs:
        _refuse_live(seconds=seconds, terminal=terminal, host=host, force=force)
    else:
        if output is None:
            raise IpsysError("no log is given; name a log, or give --rig lab.toml -o lab.mcap to use cameras")
        from ipsys_log.cli.calibrate_live import record_drive

        nominal = [("--focal", text) for text in focal or []]
        nominal += [("--field-of-view", text) for text in field_of_view or []]
        page = None if terminal else (host, port)
        record_drive(
            output,
            rig or Path("lab.toml"),
            calibration,
            nominal,
            corners,
            goal_mm / 1000,
            seconds,
            page,
            force,
        )
        # The log has the rig and the intrinsics of its cameras.
        logs, output, rig, calibration, focal, field_of_view = [output], None, None, None, None, None
    given_rig = load_matching_rig(rig, lambda: cameras_of(logs))
    _check(logs, given_rig)
    lenses = load_calibrations(calibration, lambda: cameras_of(logs))
    nominal_values = _nominal_lenses(logs, lenses, focal or [], field_of_view or [])
    if save_nominal is not None:
        _write_nominal(nominal_values, save_nominal)
    lenses = {**lenses, **nominal_values}
    options: dict[str, Any] = {
        "train": train,
        "rig": rig,
        "calibration": None,
        "corners": corners,
        "run": None,
    }
    with derive(logs, "fit", output, model=["joint"], lenses=lenses, **options) as (session, outcomes, _):
        run = next(outcome.run for outcome in reversed(outcomes) if writes(outcome, MODEL))
        recorded = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
        in_force = given_rig or rig_in_force(session, [run]) or session.payloads(session.topics(RIG))[-1]
        with progress_bar() as progress:
            lab = describe_lab(
                session, run, in_force, {**recorded, **lenses}, (given_rig, lenses), train, goal_mm / 1000,
                lambda done, total: progress("describe", done, total),
            )  # fmt: skip
        _show(lab, plot, as_json)


def _write_nominal(lenses: Mapping[str, CameraCalibration], folder: Path) -> None:
    """Write nominal intrinsics, one YAML file for each camera; no file is overwritten.

    The estimated intrinsics of the fit are not for other uses: above a level floor, focal length and height
    of a camera are nearly the same unknown.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.exchange.calibration_files import opencv_yaml
    from ipsys_log.joint.observations import lens_model_of
    from ipsys_log.report.files import check_folder, write_files

    check_folder(folder, "--save-nominal")
    if not lenses:
        raise IpsysError(
            "--save-nominal needs --focal or --field-of-view, for a camera without a calibration"
        )
    comment = "ipsys calibrate-lab: nominal values, not estimated from images"
    files = {
        f"{name}.yaml": opencv_yaml(lens, dict.fromkeys(lens_model_of(lens).names, 0.0), comment).encode()
        for name, lens in lenses.items()
    }
    for name in files:
        if (folder / name).exists():
            raise IpsysError(f"{folder / name}: exists already; give another folder to --save-nominal")
    write_files(folder, files)
    remarks.print(f"{folder} has {', '.join(files)}", markup=False)


def _check(logs: list[Path], rig: Rig | None) -> None:
    """Check that the logs have a rig and a marker or an image, before any stage runs."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages.channels import MARKERS, RIG
    from ipsys_log.runs.provenance import newest_run

    with Session(logs) as session:
        if rig is None and not session.topics(RIG):
            raise IpsysError(
                f"{session}: has no rig (markers, reference points); give one with --rig lab.toml"
            )
        if not session.images and newest_run(session, MARKERS) is None:
            raise IpsysError(
                f"{session}: has no images and no markers; record a drive with ipsys record -o drive.mcap"
            )


def _refuse_live(**options: object) -> None:
    """Refuse options that belong to a recording."""
    from ipsys_log.errors import IpsysError

    for name, value in options.items():
        if value:
            raise IpsysError(f"--{name} is only for live cameras; leave out LOG or this option")


def _nominal_lenses(
    logs: list[Path],
    given: dict[str, CameraCalibration],
    focal: list[str],
    field_of_view: list[str],
) -> dict[str, CameraCalibration]:
    """Return nominal intrinsics of the cameras of logs, by camera."""
    from ipsys_log.log.dataset import Session
    from ipsys_log.runs.checks import image_sizes

    if not focal and not field_of_view:
        return {}
    with Session(logs) as session:
        sizes_px = image_sizes(session)
        calibrated = {*session.calibrations, *given}
    options = [*(("--focal", text) for text in focal), *(("--field-of-view", text) for text in field_of_view)]
    return nominal_lenses(options, sorted(cameras_of(logs)), calibrated, sizes_px)


def nominal_lenses(
    options: Sequence[tuple[str, str]],
    cameras: Sequence[str],
    calibrated: Collection[str],
    sizes_px: Mapping[str, tuple[int, int]],
) -> dict[str, CameraCalibration]:
    """Return nominal intrinsics by camera, from focal lengths and fields of view.

    Parameters
    ----------
    options : names of options with their texts. A text without a camera is for all cameras without a
        calibration.
    cameras, calibrated : all cameras, and those with a calibration.
    sizes_px : sizes of the images by camera.

    Raises
    ------
    IpsysError
        A text is not a number, or names no camera; or the size of an image is unknown.
    """
    from ipsys_log.calibration.nominal import nominal_intrinsics
    from ipsys_log.errors import IpsysError

    lenses: dict[str, CameraCalibration] = {}
    for option, text in options:
        camera, _, number = text.rpartition("=")
        value = _positive(option, text, number)
        if camera and camera not in cameras:
            raise IpsysError(f"{option} {text}: there is no camera {camera!r}; there is {', '.join(cameras)}")
        names = [camera] if camera else [name for name in cameras if name not in calibrated]
        if not names:
            raise IpsysError(
                f"{option} {text}: every camera has a calibration; to replace one, write {cameras[0]}={text}"
            )
        for name in names:
            if name not in sizes_px:
                raise IpsysError(
                    f"camera {name}: the size of its images is unknown; write its width and height into "
                    "lab.toml, or give --calibration"
                )
            if option == "--focal":
                lenses[name] = nominal_intrinsics(name, sizes_px[name], value)
            else:
                angle_rad = math.radians(value)
                lenses[name] = nominal_intrinsics(name, sizes_px[name], field_of_view_rad=angle_rad)
    return lenses


def _positive(option: str, text: str, number: str) -> float:
    from ipsys_log.errors import IpsysError

    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        example = "red=1150 or 1150" if option == "--focal" else "red=95 or 95"
        raise IpsysError(f"{option} {text}: is not a number above 0; write it as {example}")
    return value


def _show(lab: LabCalibration, plot: Path | None, as_json: bool) -> None:
    if plot is not None:
        from ipsys_log.report.lab_calibration_figure import draw_lab

        draw_lab(lab, plot)
    if as_json:
        print(json.dumps(_as_json(lab), indent=2, allow_nan=False))  # noqa: T201
    else:
        for line in _headline(lab):
            console.print(line, markup=False, highlight=False)
        console.print()
        console.print(_table(lab))
        for line in _advice(lab):
            console.print(line, markup=False, highlight=False)
    for note in lab.notes:
        remarks.print(note, style="yellow", markup=False)
    if plot is not None:
        remarks.print(f"{plot} drawn", markup=False)


def _mm(length_m: float) -> str:
    return f"{length_m * 1000:.1f}"


def _headline(lab: LabCalibration) -> Iterator[str]:
    """Yield the answer in one line, and the probable faults, which come before all figures."""
    worst = lab.worst
    if lab.causes:
        yield "Not enough: correct the faults of the observations first."
    elif lab.missing:
        yield f"Not enough: camera {', '.join(lab.missing)} has no model."
    elif lab.is_enough:
        yield f"Enough: the expected mean error of each camera is {_mm(worst.mean_m)} mm or less."
    else:
        yield (
            f"Not enough: the expected mean error of {worst.camera} is {_mm(worst.mean_m)} mm; the goal is "
            f"{lab.goal_m * 1000:g} mm."
        )
    if lab.faults:
        count = len(lab.faults)
        yield f"{count} probable fault{'s' if count > 1 else ''} of the observations:"
        for fault in lab.faults[:_MOST_FAULTS]:
            yield f"  {fault.text}"
        if count > _MOST_FAULTS:
            yield f"  and {count - _MOST_FAULTS} more; --json prints all"


def _table(lab: LabCalibration) -> Table:
    from rich.table import Table

    title = f"Expected 2D error over the floor, {lab.height_m * 100:g} cm above it, by run {lab.run}"
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    table.add_column("camera", overflow="fold")
    for name in ("mean mm", "p95 mm", "covered", "points", "drive", "residual px", "clock ms"):
        table.add_column(name, justify="right", no_wrap=True)
    for camera in lab.cameras:
        seen = len(camera.expected.errors_m)
        points, moving = camera.sightings
        table.add_row(
            camera.camera,
            *((_mm(camera.mean_m), _mm(camera.p95_m), f"{camera.covered:.0%}") if seen else ("-", "-", "-")),
            str(points), str(moving), f"{camera.rmse_px:.3f}",
            "-" if camera.clock_s is None else f"{camera.clock_s * 1000:+.2f}",
        )  # fmt: skip
    table.add_row("all", _mm(lab.mean_m), _mm(lab.p95_m), "", str(len(lab.points_m)))
    return table


def _advice(lab: LabCalibration) -> Iterator[str]:
    if lab.is_enough:
        return
    yield ""
    if lab.gap is not None:
        low, high = (
            [f"{value * 100:.0f}" for value in corner_m] for corner_m in (lab.gap.low_m, lab.gap.high_m)
        )
        yield (
            f"Drive a robot through x {low[0]} to {high[0]}, y {low[1]} to {high[1]} cm: camera "
            f"{lab.gap.camera} saw no marker there."
        )
    for number, point in enumerate(lab.points):
        x_cm, y_cm = (f"{value * 100:.0f}" for value in point.point_m)
        tapes = ", ".join(
            f"{p.name} {math.hypot(point.point_m[0] - p.x_m, point.point_m[1] - p.y_m) * 100:.0f}"
            for p in lab.rig.reference_points
        )
        yield (
            f"{'Tape' if number == 0 else 'Then'} a point near x {x_cm}, y {y_cm} cm ({tapes}), seen by "
            f"{', '.join(point.cameras)}: {_mm(point.mean_after_m)} mm."
        )


def _as_json(lab: LabCalibration) -> dict[str, Any]:
    def number(value: float | None) -> float | None:
        return None if value is None or not math.isfinite(value) else value

    def gap(one: Any) -> dict[str, Any]:
        return {
            "camera": one.camera,
            "area_m2": one.area_m2,
            "low_m": one.low_m.tolist(),
            "high_m": one.high_m.tolist(),
            "error_mm": one.error_m * 1000,
        }

    cameras = [
        {
            "camera": camera.camera,
            "mean_mm": number(camera.mean_m * 1000),
            "p95_mm": number(camera.p95_m * 1000),
            "covered": camera.covered,
            "points": camera.sightings[0],
            "moving": camera.sightings[1],
            "residual_px": number(camera.rmse_px),
            "clock_ms": None if camera.clock_s is None else camera.clock_s * 1000,
            "nominal": camera.nominal,
            "gaps": [gap(one) for one in camera.gaps],
        }
        for camera in lab.cameras
    ]
    return {
        "enough": lab.is_enough,
        "goal_mm": lab.goal_m * 1000,
        "mean_mm": lab.mean_m * 1000,
        "p95_mm": lab.p95_m * 1000,
        "run": lab.run,
        "marker_height_m": lab.height_m,
        "calibration_points": len(lab.points_m),
        "cameras": cameras,
        "missing": list(lab.missing),
        "ignored_sightings": lab.ignored,
        "faults": [
            {"kind": f.kind, "subject": f.subject, "score": f.score, "text": f.text} for f in lab.faults
        ],
        "drive": None if lab.gap is None or lab.is_enough else gap(lab.gap),
        "tape": [
            {
                "x_m": float(point.point_m[0]),
                "y_m": float(point.point_m[1]),
                "cameras": list(point.cameras),
                "mean_after_mm": point.mean_after_m * 1000,
            }
            for point in lab.points
        ],
        "notes": list(lab.notes),
    }
