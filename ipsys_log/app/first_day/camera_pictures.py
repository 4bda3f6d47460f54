"""The pictures of the cameras that a lab can use, and the camera of the address typed last."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ipsys_log.app.first_day import camera_choice
from ipsys_log.app.first_day.jobs import Job
from ipsys_log.capture.devices import source_opener
from ipsys_log.capture.frames import AccessRefusedError
from ipsys_log.capture.usb_bus import UsbCamera
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.plain_text import hide_password

_SILENT = "the camera sends no image; check its cable and its mode"


class _Picture(NamedTuple):
    """The last picture of a camera, or the reason that there is none; ``number`` tells pictures apart."""

    number: int
    data: bytes | None
    fault: str


class CameraPictures:
    """The pictures of cameras. One thread at a time takes them, and others read the state."""

    def __init__(self, rig_file: Path) -> None:
        self._rig_file = rig_file
        self._attached: Sequence[UsbCamera] | None = None
        self._pictures: dict[str, _Picture] = {}
        self._number = 0
        self._added = 0
        self._fault: Fault | None = None

    def attached(self) -> Sequence[UsbCamera]:
        """Return the attached cameras of the last search."""
        if self._attached is None:
            self._attached = camera_choice.list_attached()
        return self._attached

    def describe(self, rig: Rig | None) -> list[dict[str, Any]]:
        """Return the cameras as plain data, without passwords."""
        rows = []
        options = camera_choice.list_options(rig, self.attached())
        for (key, text, camera), proposal in zip(
            options, camera_choice.propose_names(options, rig), strict=True
        ):
            taken = self._pictures.get(key)
            picture = f"picture/camera/{taken.number}" if taken is not None and taken.data else None
            fault = "" if taken is None else taken.fault
            row = {"key": key, "text": text, "name": camera.name, "proposal": proposal}
            rows.append({**row, "picture": picture, "fault": fault})
        return rows

    def describe_address(self) -> Mapping[str, Any]:
        """Return the form of an address: its labels, the last fault, and the number of added cameras."""
        fault = None if self._fault is None else self._fault._asdict()
        return {"labels": camera_choice.ADDRESS_FIELDS, "fault": fault, "added": self._added}

    def picture(self, number: str) -> bytes | None:
        """Return the picture with a number; None if there is none."""
        found = (one.data for one in self._pictures.values() if str(one.number) == number)
        return next(found, None)

    def take_all(self, job: Job) -> None:
        """Search for cameras, and take a picture of each, one after the other."""
        self._attached = camera_choice.list_attached()
        rig = load_rig(self._rig_file)
        for option in camera_choice.list_options(rig, self._attached):
            job.say(f"opening {option.key}")
            data, fault = None, ""
            try:
                # A camera without a name is named by its source in what it says.
                data = self._take(rig, replace(option.camera, name=option.name or option.key), job)
            except IpsysError as error:
                fault = str(error)
            if job.is_stopped():
                return
            self._keep(option.key, data, fault or ("" if data else _SILENT))

    def add(self, camera: RigCamera, job: Job) -> None:
        """Take a picture of a camera with a new source, and write the camera into the rig file.

        An error is the fault of a field, and the rig file stays as it is.
        """
        self._fault = None
        job.say(f"opening {hide_password(str(camera.source))}")
        try:
            data = self._take(load_rig(self._rig_file), camera, job)
            if job.is_stopped():
                return
            if data is None:
                raise IpsysError(_SILENT)
            camera_choice.add_camera(self._rig_file, camera)
        except AccessRefusedError as error:
            self._fault = Fault("password", camera_choice.fault_text(error, camera))
        except IpsysError as error:
            if not job.is_stopped():
                self._fault = Fault("address", camera_choice.fault_text(error, camera))
        else:
            self._keep(hide_password(str(camera.source)), data, "")
            self._added += 1

    def forget_fault(self) -> None:
        """Forget the fault of the address typed last."""
        self._fault = None

    def _take(self, rig: Rig, camera: RigCamera, job: Job) -> bytes | None:
        with source_opener(rig, [camera], self._rig_file.parent, job.is_stopped) as opener:
            return camera_choice.take_picture(camera, opener, job.say, job.is_stopped)

    def _keep(self, key: str, data: bytes | None, fault: str) -> None:
        self._number += 1
        self._pictures[key] = _Picture(self._number, data, fault)
