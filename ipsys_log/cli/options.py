"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

if TYPE_CHECKING:
    from ipsys_log.messages import CameraCalibration

__all__ = ["AsJson", "Calibrations", "Logs", "NewLog", "RigFile", "load_calibrations"]

Logs = Annotated[
    list[Path],
    typer.Argument(help="Logs, read as one. Results go to the last.", metavar="LOG..."),
]
NewLog = Annotated[Path, typer.Option("--output", "-o", help="The log to write.")]
RigFile = Annotated[Path | None, typer.Option("--rig", help="A rig file to use instead of the log's rig.")]
Calibrations = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option(
        "--calibration",
        metavar="CAMERA=FILE",
        help="A camera's lens instead of the log's: OpenCV YAML. Repeat for each camera; or another log.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def load_calibrations(options: list[str] | None) -> dict[str, CameraCalibration]:
    """Lenses by camera from ``camera=file.yaml`` or ``other.mcap``.

    Raises
    ------
    IpsysError
        For an option of another form, or a file that holds no calibration.
    """
    from ipsys_log.errors import IpsysError
    from ipsys_log.formats.opencv_yaml import read_opencv_calibration
    from ipsys_log.log.session import Session

    lenses: dict[str, CameraCalibration] = {}
    for option in options or []:
        camera, equals, name = option.partition("=")
        if equals:
            found = {camera: read_opencv_calibration(Path(name), camera)}
        elif option.endswith(".mcap"):
            with Session([Path(option)]) as log:
                found = {c: log.payloads([topic])[-1] for c, topic in log.calibrations.items()}
            if not found:
                raise IpsysError(f"{option}: holds no camera calibration")
        else:
            raise IpsysError(f"--calibration {option}: write it as camera=file.yaml, or name a log (.mcap)")
        for name in found:
            if name in lenses:
                raise IpsysError(f"--calibration: two cameras of one name, {name!r}")
        lenses.update(found)
    return lenses
