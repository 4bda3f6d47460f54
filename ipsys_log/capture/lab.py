"""The cameras of a lab: described by files, and open with the first messages of their recording."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

from ipsys_log.capture.camera_thread import imported_run
from ipsys_log.capture.devices import source_opener
from ipsys_log.capture.disk import DiskRoom, expected_bytes_per_s, free_room
from ipsys_log.capture.frames import Clock, Open, Say
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.engine.output import record_message
from ipsys_log.engine.provenance import NODE_FORMAT
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import (
    ASSUMED_MODEL,
    EVENTS_TOPIC,
    IMPORTED,
    RIG_TOPIC,
    CameraCalibration,
    Event,
    Message,
    Rig,
    RigCamera,
    Run,
    calibration_topic,
)
from ipsys_log.vision.lenses import scale_intrinsics


@dataclass(frozen=True, slots=True, eq=False)
class Lab:
    """The cameras to open.

    Attributes
    ----------
    rig, cameras : the rig, and those of its cameras that are wanted.
    lenses : the intrinsics by camera.
    folder : the folder of the rig file.
    assumed : a text for each camera whose calibration file does not state the lens model.
    files : input files with their names in messages; a recording must not overwrite them.
    """

    rig: Rig
    cameras: Sequence[RigCamera]
    lenses: dict[str, CameraCalibration]
    folder: Path = Path()
    assumed: Mapping[str, str] = field(default_factory=dict)
    files: Sequence[tuple[str, LogLocation]] = ()

    @property
    def names(self) -> list[str]:
        return [camera.name for camera in self.cameras]


@dataclass(frozen=True, slots=True, eq=False)
class OpenLab:
    """The open cameras of a lab.

    Attributes
    ----------
    lenses : intrinsics that fit the frames of the cameras.
    settings : the first messages of the log.
    """

    lab: Lab
    cameras: LiveCameras
    lenses: Mapping[str, CameraCalibration]
    settings: list[Message]

    @property
    def rig(self) -> Rig:
        return self.lab.rig

    def room(self, log: Path) -> DiskRoom:
        """Return the free disk space for a log, and how fast the cameras fill it."""
        return free_room(log, expected_bytes_per_s(self.lab.cameras, self.cameras.states))


@contextmanager
def open_lab(
    lab: Lab, say: Say, clock: Clock | None = None, open_source: Open | None = None
) -> Iterator[OpenLab]:
    """Open the cameras of a lab until the end of the block.

    Parameters
    ----------
    say : called with remarks and with the text of each event.
    clock : the clock of all stamps; None: the system's.
    open_source : opens a camera; None: the source of the camera does.

    Raises
    ------
    IpsysError
        A camera cannot be opened, or its frames do not fit its intrinsics.
    """
    with ExitStack() as stack:
        if open_source is None:
            open_source = stack.enter_context(source_opener(lab.rig, lab.cameras, lab.folder))
        cameras = stack.enter_context(LiveCameras(lab.cameras, open_source, clock or Clock(), say))
        sizes_px = {name: state.size_px for name, state in cameras.states.items()}
        lenses = fitting_lenses(lab.lenses, sizes_px, say)
        settings = first_messages(lab.rig, lenses, cameras.now_ns, imported_run(cameras.states), lab.assumed)
        yield OpenLab(lab, cameras, lenses, settings)


def fitting_lenses(
    lenses: Mapping[str, CameraCalibration],
    sizes_px: Mapping[str, tuple[int, int] | None],
    say: Callable[[str], None],
) -> dict[str, CameraCalibration]:
    """Return intrinsics for the frames of cameras, scaled for another size; ``say`` reports this."""
    fitting = {}
    for camera, lens in lenses.items():
        width, height = sizes_px.get(camera) or (lens.width, lens.height)
        fitting[camera] = scale_intrinsics(lens, width, height, f"camera {camera}")
        if width != lens.width:
            say(f"camera {camera}: its calibration is scaled from a width of {lens.width} px to {width} px")
    return fitting


def first_messages(
    rig: Rig,
    lenses: Mapping[str, CameraCalibration],
    now_ns: Callable[[], int],
    imported_run: str | None = None,
    assumed: Mapping[str, str] = MappingProxyType({}),
) -> list[Message]:
    """Return the first messages of a log: the rig, intrinsics by camera, and the record of a run.

    Parameters
    ----------
    imported_run : the run of markers that other hosts have detected.
    assumed : texts by camera for calibration files that do not state their lens model.
    """
    time_ns = now_ns()
    messages = [Message(RIG_TOPIC, time_ns, time_ns, rig)]
    for camera, lens in sorted(lenses.items()):
        time_ns = now_ns()
        stamped = replace(lens, timestamp=time_ns)
        messages.append(Message(calibration_topic(camera), time_ns, time_ns, stamped, camera))
    for camera, text in sorted(assumed.items()):
        time_ns = now_ns()
        messages.append(Message(EVENTS_TOPIC, time_ns, time_ns, Event(time_ns, ASSUMED_MODEL, text, camera)))
    if imported_run is not None:
        time_ns = now_ns()
        record = Run(time_ns, imported_run, IMPORTED, {"format": NODE_FORMAT})
        messages.append(record_message(record, time_ns))
    return messages
