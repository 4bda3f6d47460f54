"""The files of a lab: cameras of the rig file with their intrinsics, and the new files of a simulated lab."""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from ipsys_log.capture.devices import check_sources
from ipsys_log.capture.lab import Lab
from ipsys_log.capture.simulated import intrinsics_of
from ipsys_log.capture.simulation.live_lab import LIVE_SETTINGS, live_rig, plan_live_lab, tape_sheet
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import read_intrinsics
from ipsys_log.log.location import describe_broken_link
from ipsys_log.messages import CameraCalibration, Rig, RigCamera
from ipsys_log.messages.rig_file import load_rig, rig_toml
from ipsys_log.stages.detect.search import marker_detector

# The beginning of the rig file of the simulated lab.
_SIMULATED = """# The simulated lab, without hardware. docs/first-day.md goes through all commands with it.
# The robots 0, 1 and 2 drive to and fro at a height of 10 cm. The other markers do not move.

"""


def read_lab(
    path: Path, only: Collection[str] = (), given: Mapping[str, CameraCalibration] = MappingProxyType({})
) -> Lab:
    """Read the cameras of a rig file with their intrinsics, and check their sources.

    Parameters
    ----------
    only : names of some cameras; none: all cameras with a source.
    given : intrinsics that replace those of the rig, by camera.
    """
    rig, cameras = load_cameras(path, only)
    assumed: dict[str, str] = {}
    lenses = load_lenses(path, cameras, given, report=assumed.__setitem__)
    check_sources(cameras)
    return Lab(rig, cameras, lenses, path.parent, assumed)


def load_cameras(path: Path, only: Collection[str] = ()) -> tuple[Rig, list[RigCamera]]:
    """Return the rig of a file, and its cameras that have a source, or only the cameras in ``only``."""
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
    path: Path,
    cameras: Sequence[RigCamera],
    given: Mapping[str, CameraCalibration],
    read: bool = True,
    report: Callable[[str, str], None] = lambda camera, text: None,
) -> dict[str, CameraCalibration]:
    """Return the intrinsics of cameras: the given ones, else those from the files that the rig names.

    Parameters
    ----------
    path : path of the rig file; names of files are relative to its folder.
    read : read the files; without it, only the given intrinsics are returned.
    report : called with a camera and a remark if its file does not state the lens model.
    """
    names = [camera.name for camera in cameras]
    lenses = dict(given)
    for camera in cameras if read else ():
        if camera.name not in lenses and camera.calibration is not None:
            lenses[camera.name] = read_intrinsics(path.parent / camera.calibration, camera.name, report)
        elif camera.name not in lenses and str(camera.source).startswith("sim:"):
            lenses[camera.name] = intrinsics_of(camera)
    unknown = sorted(set(lenses) - set(names))
    if unknown:
        raise IpsysError(
            f"--calibration {unknown[0]}: this camera is not recorded; the cameras are {', '.join(names)}"
        )
    return lenses


def tape_sheet_path(path: Path) -> Path:
    """Return the path of the sheet of tape measurements beside the rig file of a simulated lab."""
    return path.parent / f"{path.stem}_tape.csv"


def simulated_lab_texts(path: Path) -> dict[Path, str]:
    """Return the files of the simulated lab: its rig file ``path``, and the sheet of its tape readings."""
    stationary = plan_live_lab(LIVE_SETTINGS).stationary
    return {
        path: _SIMULATED + rig_toml(live_rig(LIVE_SETTINGS)),
        tape_sheet_path(path): tape_sheet(stationary),
    }


def write_new(texts: Mapping[Path, str]) -> None:
    """Write files that do not exist yet: all of them, or none."""
    made: list[Path] = []
    try:
        for path, text in texts.items():
            with path.open("x", encoding="utf-8") as file:
                made.append(path)
                file.write(text)
    except OSError as error:
        for path in made:
            path.unlink()
        if isinstance(error, FileExistsError):
            taken = Path(error.filename)
            text = describe_broken_link(taken) or f"{taken}: exists already; edit it, or give another name"
            raise IpsysError(text) from error
        raise
