"""The rig and the camera intrinsics that options name: files, logs, and nominal values."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ipsys_log.app.cli.console import say, warn
from ipsys_log.app.cli.options import setting
from ipsys_log.app.report.files import check_folder, write_files
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation, LogUrl, parse_location

if TYPE_CHECKING:
    from ipsys_log.capture.lab import Lab
    from ipsys_log.log.dataset import Session
    from ipsys_log.messages import CameraCalibration, Rig

Focal = Annotated[
    list[str] | None,
    setting(
        "--focal",
        "[CAMERA=]PX",
        "Nominal focal length in pixels, of one camera, or of all cameras without a calibration. The "
        "fit estimates the intrinsics.",
    ),
]
FieldOfView = Annotated[
    list[str] | None,
    setting(
        "--field-of-view", "[CAMERA=]DEGREES", "Nominal horizontal field of view, instead of a focal length."
    ),
]
SaveNominal = Annotated[
    Path | None,
    setting(
        "--save-nominal",
        "DIR",
        "With LOG: write the nominal intrinsics into this folder, such as red.yaml, for lab.toml and "
        "--calibration of later commands.",
    ),
]


def load_calibrations(
    options: list[str] | None,
    cameras: Callable[[], Collection[str]],
    assume: Callable[[str, str], None] = lambda camera, text: None,
) -> dict[str, CameraCalibration]:
    """Read intrinsics by camera from ``camera=file``, or from ``other.mcap`` for the given ``cameras``.

    ``assume`` is called with a camera and a text if its file does not state the lens model. The text and
    remarks on unusual values are printed.
    """
    if not options:
        return {}
    from ipsys_log.exchange.calibration_files import read_intrinsics
    from ipsys_log.log.dataset import Session

    def report(camera: str, text: str) -> None:
        say_remark(camera, text)
        assume(camera, text)

    lenses: dict[str, CameraCalibration] = {}
    for option in options:
        camera, place = split_calibration(option)
        if camera is not None:
            calibrations = {camera: read_intrinsics(place, camera, report)}
        elif place.suffix == ".mcap":
            with Session([place]) as log:
                known = [camera for camera in log.calibrations if camera in cameras()]
            calibrations = {camera: read_intrinsics(place, camera, report) for camera in known}
            if not calibrations:
                raise IpsysError(
                    f"--calibration {place}: has no calibration of these cameras; give another log"
                )
        else:
            raise IpsysError(
                f"--calibration {place}: has no camera name; write camera=file.yaml, or name a log (.mcap)"
            )
        for name in calibrations:
            if name in lenses:
                raise IpsysError(f"--calibration: camera {name!r} has two calibrations; give one")
        lenses.update(calibrations)
    say_unusual(lenses)
    return lenses


def say_remark(camera: str, text: str) -> None:
    """Print a remark on the calibration of a camera."""
    warn(f"camera {camera}: {text}")


def say_unusual(lenses: Mapping[str, CameraCalibration]) -> None:
    """Print remarks on unusual values of calibrations."""
    from ipsys_log.vision.lenses import calibration_remarks

    for camera, lens in sorted(lenses.items()):
        for text in calibration_remarks(lens):
            say_remark(camera, text)


def split_calibration(option: str) -> tuple[str | None, LogLocation]:
    """Return the camera and the file of ``camera=file``; the camera is None if the option names only a log.

    The query of a URL may have an equals sign, too.
    """
    camera, equals, name = option.partition("=")
    if not equals or isinstance(parse_location(option), LogUrl):
        return None, parse_location(option)
    return camera, parse_location(name)


def load_matching_rig(path: Path | None, cameras: Callable[[], Collection[str]]) -> Rig | None:
    """Read a rig for cameras that are given by their images; None if no file is named.

    A rig that describes only some of the cameras causes a remark.
    """
    if path is None:
        return None
    from ipsys_log.messages.rig_file import check_rig_cameras, load_rig

    rig = load_rig(path)
    for text in check_rig_cameras(rig, cameras(), f"--rig {path}"):
        warn(text)
    return rig


def read_lab(
    rig: Path | None, calibration: list[str] | None, cameras: Collection[str]
) -> tuple[Rig | None, dict[str, CameraCalibration], dict[str, str]]:
    """Return the rig of an import, the intrinsics of its cameras, and texts on their assumed lens models.

    The intrinsics are the given ones, else those of the files that the rig names, as far as they exist.
    """
    from ipsys_log.exchange.lab_files import load_lenses

    assumed: dict[str, str] = {}
    lenses = load_calibrations(calibration, lambda: cameras, assumed.__setitem__)
    lab = load_matching_rig(rig, lambda: cameras)
    if rig is None or lab is None:
        return lab, lenses, assumed
    named = [camera for camera in lab.cameras if camera.name in cameras and camera.name not in lenses]
    for camera in named:
        if camera.calibration is not None and (rig.parent / camera.calibration).exists():
            from_rig = load_lenses(rig, [camera], {}, report=assumed.__setitem__)
            say_unusual(from_rig)
            lenses |= from_rig
        elif camera.calibration is not None:
            text = f"{camera.calibration} of the rig does not exist; 'ipsys calibrate' writes it"
            say_remark(camera.name, text)
        if camera.name in assumed:
            say_remark(camera.name, assumed[camera.name])
    return lab, lenses, assumed


def lab_of_run(
    session: Session, run: str, rig: Rig | None, lenses: Mapping[str, CameraCalibration]
) -> tuple[Rig, dict[str, CameraCalibration]]:
    """Return the rig and the intrinsics of a run: the given ones, else those of the log."""
    from ipsys_log.messages.channels import RIG
    from ipsys_log.sinks.selection import rig_in_force

    in_force = rig or rig_in_force(session, [run]) or session.payloads(session.topics(RIG))[-1]
    return in_force, lenses_of(session, lenses)


def lenses_of(session: Session, lenses: Mapping[str, CameraCalibration]) -> dict[str, CameraCalibration]:
    """Return the intrinsics of all cameras: the given ones, else those of the log."""
    recorded = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
    return {**recorded, **lenses}


def load_lab(
    rig: Path, calibration: list[str] | None, only: Collection[str], with_lenses: bool = True
) -> Lab:
    """Return the cameras of a rig file that have a source (or ``only`` some), with their intrinsics.

    The intrinsics come from ``calibration``, else from the file that the rig names, relative to the rig file.
    The files of the rig are read only ``with_lenses``.
    """
    from ipsys_log.capture.lab import Lab
    from ipsys_log.exchange.lab_files import load_cameras, load_lenses

    described, cameras = load_cameras(rig, only)
    names = [camera.name for camera in cameras]
    assumed: dict[str, str] = {}
    given = load_calibrations(calibration, lambda: names, assumed.__setitem__)
    from_files: dict[str, str] = {}
    lenses = load_lenses(rig, cameras, given, with_lenses, from_files.__setitem__)
    for camera, text in from_files.items():
        say_remark(camera, text)
    say_unusual({camera: lens for camera, lens in lenses.items() if camera not in given})
    return Lab(described, cameras, lenses, rig.parent, assumed | from_files)


def cameras_of(logs: Sequence[LogLocation]) -> set[str]:
    """Return the cameras of which logs have frames or derived channels."""
    from ipsys_log.log.contents import camera_of_topic
    from ipsys_log.log.dataset import Session

    with Session(logs) as session:
        derived = {camera_of_topic(topic) for reader in session.readers for topic in reader.channels}
        return set(session.images) | {camera for camera in derived if camera}


def nominal_lenses_of_logs(
    logs: Sequence[LogLocation], given: dict[str, CameraCalibration], options: Sequence[tuple[str, str]]
) -> dict[str, CameraCalibration]:
    """Return nominal intrinsics of the cameras of logs, by camera; see :func:`nominal_lenses`."""
    from ipsys_log.engine.checks import image_sizes
    from ipsys_log.log.dataset import Session

    if not options:
        return {}
    with Session(logs) as session:
        sizes_px = image_sizes(session)
        calibrated = {*session.calibrations, *given}
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
    """
    from ipsys_log.calibration.lens_models import nominal_intrinsics

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
    from ipsys_log.calibration.joint.observations import lens_model_of
    from ipsys_log.exchange.calibration_files import opencv_yaml

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
