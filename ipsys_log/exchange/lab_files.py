"""The cameras of a lab: the cameras of the rig file, with their intrinsics."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from ipsys_log.capture.simulated import intrinsics_of
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import read_intrinsics
from ipsys_log.messages import CameraCalibration, Rig, RigCamera
from ipsys_log.rig.file import load_rig
from ipsys_log.stages.detect import marker_detector

__all__ = ["load_cameras", "load_lenses"]


def load_cameras(path: Path, only: Collection[str] = ()) -> tuple[Rig, list[RigCamera]]:
    """Return the rig of a file, and its cameras that have a source, or only the cameras in ``only``.

    Raises
    ------
    IpsysError
        The rig has no such camera, or no camera with a source.
    """
    rig = load_rig(path)
    marker_detector(rig.dictionary)  # a wrong name is an error now, not at the first frame
    known = {camera.name: camera for camera in rig.cameras}
    for name in only:
        if name not in known:
            raise IpsysError(
                f"--camera {name}: {path} does not have this camera; it has {', '.join(known) or 'none'}"
            )
    cameras = [camera for camera in rig.cameras if (camera.name in only if only else camera.source)]
    for camera in cameras:
        if camera.source is None:
            raise IpsysError(
                f'{path}: camera {camera.name} has no source; write, for example, source = "usb:/dev/video0"'
            )
    if not cameras:
        raise IpsysError(
            f'{path}: no camera has a source; write one for each camera, such as source = "usb:/dev/video0" '
            "(see 'ipsys cameras')"
        )
    return rig, cameras


def load_lenses(
    path: Path, cameras: Sequence[RigCamera], given: Mapping[str, CameraCalibration], read: bool = True
) -> dict[str, CameraCalibration]:
    """Return the intrinsics of cameras: the given ones, else those from the files that the rig names.

    Parameters
    ----------
    path : path of the rig file; names of files are relative to its folder.
    read : read the files; without it, only the given intrinsics are returned.

    Raises
    ------
    IpsysError
        A file cannot be read, or intrinsics are given for another camera.
    """
    names = [camera.name for camera in cameras]
    lenses = dict(given)
    for camera in cameras if read else ():
        if camera.name not in lenses and camera.calibration is not None:
            lenses[camera.name] = read_intrinsics(path.parent / camera.calibration, camera.name)
        elif camera.name not in lenses and str(camera.source).startswith("sim:"):
            lenses[camera.name] = intrinsics_of(camera)
    unknown = sorted(set(lenses) - set(names))
    if unknown:
        raise IpsysError(
            f"--calibration {unknown[0]}: this camera is not recorded; the cameras are {', '.join(names)}"
        )
    return lenses
