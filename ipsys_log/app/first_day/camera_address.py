"""Typed addresses of cameras that no list shows: network cameras, nodes, and numbered cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain
from urllib.parse import quote

from ipsys_log.app.first_day.camera_choice import free_names
from ipsys_log.capture.devices import check_sources
from ipsys_log.capture.nodes.centre import is_of_node, node_of
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.messages.rig_file import check_name
from ipsys_log.plain_text import hide_password

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
    """Return the name of a camera: the typed one, or a free one.

    Raises
    ------
    IpsysError
        The typed name is not valid, or another camera has it.
    """
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
