"""Nominal camera intrinsics from options: focal lengths and fields of view."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.cli.console import say
from ipsys_log.cli.options import cameras_of

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from ipsys_log.log.location import LogLocation
    from ipsys_log.messages import CameraCalibration

Focal = Annotated[
    list[str] | None,
    typer.Option(
        "--focal",
        metavar="[CAMERA=]PX",
        help="Nominal focal length in pixels, of one camera, or of all cameras without a calibration. The "
        "fit estimates the intrinsics.",
    ),
]
FieldOfView = Annotated[
    list[str] | None,
    typer.Option(
        "--field-of-view",
        metavar="[CAMERA=]DEGREES",
        help="Nominal horizontal field of view, instead of a focal length.",
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


def nominal_lenses_of_logs(
    logs: Sequence[LogLocation],
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


def write_nominal(lenses: Mapping[str, CameraCalibration], folder: Path) -> None:
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
    say(f"{folder} has {', '.join(files)}")
