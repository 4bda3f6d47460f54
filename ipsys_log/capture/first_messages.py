"""The first messages of a recording: the rig, and the intrinsics that fit the frames of the cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

from ipsys_log.geometry.lenses import scale_intrinsics
from ipsys_log.messages import (
    ASSUMED_MODEL,
    EVENTS_TOPIC,
    IMPORTED,
    RIG_TOPIC,
    CameraCalibration,
    Event,
    Message,
    Rig,
    Run,
    calibration_topic,
)
from ipsys_log.runs.output import record_message
from ipsys_log.runs.provenance import NODE_FORMAT


def fitting_lenses(
    lenses: Mapping[str, CameraCalibration],
    sizes_px: Mapping[str, tuple[int, int] | None],
    say: Callable[[str], None],
) -> dict[str, CameraCalibration]:
    """Return intrinsics for the frames of cameras, scaled for frames of another size; ``say`` reports this.

    Raises
    ------
    IpsysError
        The frames have another aspect ratio.
    """
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
