"""The cameras that a lab can use: of the rig, attached, simulated or typed, each with a picture."""

import re
import sys
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import cv2

from ipsys_log.app.first_day.rig_entry import replace_tables, write_rig
from ipsys_log.capture.devices import check_sources
from ipsys_log.capture.frames import Clock, Frame, Open, Say
from ipsys_log.capture.nodes.centre import is_of_node, node_of
from ipsys_log.capture.nodes.wire import MARKERS_FORMAT
from ipsys_log.capture.simulated import parse_source
from ipsys_log.capture.simulation.live_lab import LIVE_SETTINGS
from ipsys_log.capture.usb_bus import UsbCamera, find_cameras
from ipsys_log.errors import FrameError, IpsysError
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.messages import CompressedVideo, Rig, RigCamera
from ipsys_log.messages.rig_file import check_name, check_rig, load_rig
from ipsys_log.plain_text import hide_password
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.video import decode_keyframe, is_keyframe

# The search for a picture ends after this time.
_LONGEST_WAIT_NS = 60 * NS_PER_S


class CameraOption(NamedTuple):
    """A camera that the lab can use.

    ``key`` is its source without a password. ``text`` describes it, and ``name`` is its name in the rig,
    empty if the lab does not use it.
    """

    key: str
    text: str
    camera: RigCamera

    @property
    def name(self) -> str:
        return self.camera.name


def list_attached() -> list[UsbCamera]:
    """Return the attached cameras; only Linux lists them."""
    return find_cameras() if sys.platform == "linux" else []


def list_options(rig: Rig | None, attached: Sequence[UsbCamera]) -> list[CameraOption]:
    """Return the cameras of the rig, then attached cameras and simulated ones that the rig does not use."""
    used = [camera for camera in rig.cameras if camera.source] if rig else []
    options = [CameraOption(hide_password(str(camera.source)), "in lab.toml", camera) for camera in used]
    options += _unused(attached, used)
    simulated = [RigCamera("", source=f"sim:{name}") for name in LIVE_SETTINGS.cameras]
    present = {_simulated_number(camera) for camera in used if str(camera.source).startswith("sim:")}
    return options + [
        CameraOption(str(camera.source), "simulated lab, without hardware", camera)
        for camera in simulated
        if _simulated_number(camera) not in present
    ]


def propose_names(options: Sequence[CameraOption], rig: Rig | None) -> list[str]:
    """Return a name for each option: its own, that of the simulated camera, or the next free one."""
    taken = {option.name for option in options}
    free = free_names(rig, taken)
    names = []
    for option in options:
        simulated = option.key.removeprefix("sim:")
        own = option.name or (simulated if simulated in LIVE_SETTINGS.cameras else "")
        name = own if own and (option.name or own not in taken) else next(free)
        taken.add(name)
        names.append(name)
    return names


def free_names(rig: Rig | None, taken: Container[str]) -> Iterator[str]:
    """Yield names of cameras that are not taken: those of the rig without a source, then numbered ones."""
    planned = [camera.name for camera in rig.cameras if not camera.source] if rig else []
    numbered = (f"camera_{number}" for number in count(1))
    return (name for name in chain(planned, numbered) if name not in taken)


def save_cameras(path: Path, names: Mapping[str, str], attached: Sequence[UsbCamera]) -> list[Fault]:
    """Write the named cameras into the rig file; return the faults of names instead.

    Parameters
    ----------
    names : the name of each used camera, by the key of its option; cameras without a name are not used.
    attached : the attached cameras that the user has seen.
    """
    rig = load_rig(path)
    options = {option.key: option for option in list_options(rig, attached)}
    chosen: list[RigCamera] = []
    faults: list[Fault] = []
    for key, typed in names.items():
        name = typed.strip()
        if not name:
            continue
        if key not in options:
            raise IpsysError("this camera is not attached any more; search for cameras again")
        try:
            check_name(name, "camera name")
        except IpsysError as error:
            faults.append(Fault(key, str(error)))
        if any(camera.name == name for camera in chosen):
            faults.append(Fault(key, f"two cameras have the name {name!r}; give each its own"))
        chosen.append(_settings(options[key].camera, name, rig))
    if faults:
        return faults
    if not chosen:
        raise IpsysError("no camera has a name; type a name for each camera that the lab uses")
    check_rig(replace(rig, cameras=tuple(chosen)), path.name)
    check_sources(chosen)
    _write_cameras(path, rig, chosen)
    return []


def add_camera(path: Path, camera: RigCamera) -> None:
    """Write a camera with a new source into the rig file.

    A camera of the rig with the same source, apart from its password, gets the new source and the new name.
    The entry of its name without a source gets the source.
    """
    rig = load_rig(path)
    key, cameras = hide_password(str(camera.source)), list(rig.cameras)
    same = [n for n, one in enumerate(cameras) if one.source and hide_password(one.source) == key]
    planned = [n for n, one in enumerate(cameras) if not one.source and one.name == camera.name]
    for place in (same or planned)[:1]:
        camera = cameras[place] = replace(cameras[place], name=camera.name, source=camera.source)
    if camera not in cameras:
        cameras.append(camera)
    _write_cameras(path, rig, [one for one in cameras if one.source or one.name != camera.name])


def set_calibration(path: Path, camera: str, file: str) -> None:
    """Write the name of a file of intrinsics into the rig file."""
    rig = load_rig(path)
    cameras = tuple(replace(one, calibration=file) if one.name == camera else one for one in rig.cameras)
    _write_cameras(path, rig, cameras)


def _write_cameras(path: Path, rig: Rig, cameras: Sequence[RigCamera]) -> None:
    text = replace_tables(path.read_text(encoding="utf-8"), "[[cameras]]", cameras)
    write_rig(path, text, replace(rig, cameras=tuple(cameras)))


def take_picture(camera: RigCamera, opener: Open, say: Say, is_stopped: Callable[[], bool]) -> bytes | None:
    """Open a camera, and return its first image as JPEG or PNG; None if it sends none, or after a stop."""
    clock = Clock()
    end_ns = clock.now_ns() + _LONGEST_WAIT_NS
    with opener(camera, clock, say) as frames:
        for frame in frames:
            if is_stopped() or clock.now_ns() > end_ns:
                return None
            if isinstance(frame, Frame) and (picture := _picture(frame)) is not None:
                return picture
    return None


def _picture(frame: Frame) -> bytes | None:
    if frame.format in ("jpeg", "png"):
        return frame.data
    if frame.format == MARKERS_FORMAT:  # from a node that sends no images
        return None
    video = CompressedVideo(0, "", frame.data, frame.format)
    if not is_keyframe(video):
        return None
    try:
        return cv2.imencode(".jpg", decode_grey(decode_keyframe(video)))[1].tobytes()
    except FrameError:
        return None


def _unused(attached: Sequence[UsbCamera], used: Sequence[RigCamera]) -> Iterator[CameraOption]:
    """Yield the attached cameras that the rig does not use, by their stable device path."""
    taken = {
        Path(str(camera.source).partition(":")[2]).resolve()
        for camera in used
        if str(camera.source).startswith("usb:/")
    }
    for found in attached:
        if Path(found.device).resolve() not in taken:
            source = f"usb:{found.stable or found.device}"
            text = f"{found.name}; {found.fault}" if found.fault else found.name
            yield CameraOption(source, text, RigCamera("", source=source))


def _simulated_number(camera: RigCamera) -> int | None:
    """Return the number of a camera in the simulated lab; None for a source with a fault."""
    try:
        return parse_source(camera).number
    except IpsysError:
        return None


def _settings(camera: RigCamera, name: str, rig: Rig) -> RigCamera:
    """Return a chosen camera; a new one gets the settings of the entry of its name without a source."""
    planned = next((one for one in rig.cameras if one.name == name and not one.source), RigCamera(name))
    if camera.name:
        return replace(camera, name=name)
    return replace(planned, source=camera.source)


# The fields of the form: key, label.
ADDRESS_FIELDS = {
    "address": "Address, such as rtsp://192.168.1.20/stream",
    "user": "User, if the camera asks for one",
    "password": "Password",
    "new_name": "Name; empty: the next free one",
}
# A page names no file and no device: a path on this machine is not for the devices in its network.
_SCHEMES = ("rtsp", "rtsps", "http", "https", "tcp", "udp")
_NUMBERED = re.compile(r"usb:\d{1,3}")
_LONGEST = 1000
_EXAMPLES = "write rtsp://192.168.1.20/stream, http://192.168.1.20:8080/video, zenoh:red or usb:0"
_LOCAL = {
    "file": "a page cannot name a file; write it into lab.toml with a text editor",
    "usb": "a page cannot name a device; press 'Search and take pictures' to list the cameras",
    "sim": "the simulated cameras are listed on this page; give one of them a name",
}


def parse_camera_address(typed: Mapping[str, str], rig: Rig) -> RigCamera | Fault:
    """Return the typed camera with its name and source; or the fault of a field.

    Parameters
    ----------
    typed : texts by field. An empty name is that of the camera with this address, or the next free one.
    rig : the present rig.
    """
    texts = {key: typed.get(key, "") for key in ADDRESS_FIELDS}
    address, user, name = (texts[key].strip() for key in ("address", "user", "new_name"))
    fault = _address_fault(address) or _user_fault(address, user, texts["password"])
    if fault is not None:
        return fault
    source = _with_user(address, user, texts["password"])
    camera = RigCamera("new", source=source)
    try:
        check_sources([camera])
    except IpsysError as error:
        return Fault("address", fault_text(error, camera))
    try:
        return replace(camera, name=_name(name, camera, rig))
    except IpsysError as error:
        return Fault("new_name", str(error))


def fault_text(error: IpsysError, camera: RigCamera) -> str:
    """Return the text of an error beside the field of its camera: without the name of the camera."""
    return str(error).removeprefix(f"camera {camera.name}: ")


def _address_fault(address: str) -> Fault | None:
    if not address:
        return Fault("address", f"the address is empty; {_EXAMPLES}")
    if len(address) > _LONGEST or not address.isprintable() or " " in address:
        return Fault("address", f"the address has a space, or more than {_LONGEST} characters; {_EXAMPLES}")
    kind, _, rest = address.partition(":")
    kind, shown = kind.lower(), hide_password(address)
    if (
        (kind in _SCHEMES and rest.startswith("//"))
        or address.startswith("zenoh:")
        or _NUMBERED.fullmatch(address)
    ):
        return None
    if kind in _LOCAL:
        return Fault("address", f"{shown!r}: {_LOCAL[kind]}")
    return Fault("address", f"{shown!r} is not the address of a camera; {_EXAMPLES}")


def _user_fault(address: str, user: str, password: str) -> Fault | None:
    if not user and not password:
        return None
    if not user:
        return Fault("user", "the user is empty; a password needs a user")
    if "://" not in address:
        return Fault("user", f"{address} has no user; only an address with :// has one")
    if "@" in re.split("[/?#]", address.partition("://")[2], maxsplit=1)[0]:
        return Fault("user", "the address has a user already; remove it there, or here")
    return None


def _with_user(address: str, user: str, password: str) -> str:
    """Return an address with a user and a password; their special characters are escaped (RFC 3986)."""
    if not user:
        return address
    scheme, _, rest = address.partition("://")
    return f"{scheme}://{quote(user, safe='')}:{quote(password, safe='')}@{rest}"


def _name(name: str, camera: RigCamera, rig: Rig) -> str:
    """Return the name of a camera: the typed one if it is valid and not taken, or a free one."""
    key = hide_password(str(camera.source))
    others = [one for one in rig.cameras if one.source and hide_password(one.source) != key]
    taken = {one.name for one in others}
    if name:
        if name in taken:
            raise IpsysError(f"two cameras have the name {name!r}; give each its own")
        return check_name(name, "camera name")
    same = [one.name for one in rig.cameras if one.source and one not in others]
    node = [node_of(camera)] if is_of_node(camera) else []
    return next(one for one in chain(same, node, free_names(rig, taken)) if one not in taken)
