"""Rig file ``lab.toml``: its reader, its checks, and its commented example."""

import json
import math
import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import MISSING, fields, replace
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    Floor,
    ReferenceMarker,
    ReferencePoint,
    Rig,
    RigBody,
    RigCamera,
    RigMarker,
    RigNodes,
    RigStream,
)
from ipsys_log.messages.rig_checks import LARGEST_SCALE_SIGMA, check_bodies, check_unique, check_units
from ipsys_log.plain_text import hide_password, shell_words

Item = TypeVar("Item")

# Markers are below the cameras. A greater height is in cm.
_HIGHEST_M = 5.0
_FARTHEST = 1e6  # m, px, s or Hz: no number of a lab is larger
_LARGEST_INT = {"_ns": 2**62}  # by the last three characters of a name
_LARGEST_ID = 2**31 - 1
_LARGEST_FILE = 1 << 18  # bytes
_LARGEST_PORT = 65535
_MARKER = re.compile(r"marker_\d{1,4}")
_LONGEST_LINE = 120  # characters of a line that an error repeats

# Meaning of the time that a driver gives to a frame: start or end of the exposure.
STAMPS = ("start", "end")

_NAME = re.compile(r"[a-z][a-z0-9_]*")
_ITEMS = {
    "markers": RigMarker,
    "bodies": RigBody,
    "cameras": RigCamera,
    "reference_points": ReferencePoint,
    "reference_markers": ReferenceMarker,
}


def check_name(name: str, what: str) -> str:
    """Return ``name`` if it is a valid name of a camera, run or robot.

    Raises
    ------
    IpsysError
        The name is not valid. Such names become parts of topics.
    """
    if not _NAME.fullmatch(name):
        raise IpsysError(f"{what} {name!r} must be small letters, digits and _, starting with a letter")
    return name


def check_rig_cameras(rig: Rig, cameras: Collection[str], where: str) -> list[str]:
    """Check that a rig describes the cameras of a log or of images.

    Parameters
    ----------
    rig : the rig; a rig without cameras matches all cameras.
    cameras : camera names in the log or the images.
    where : the rig file, for the message.

    Returns
    -------
    A remark if the rig does not describe some of the cameras.
    """
    described = [camera.name for camera in rig.cameras]
    missing = sorted(set(cameras) - set(described))
    if not described or not missing:
        return []
    if len(missing) == len(set(cameras)):
        raise IpsysError(
            f"{where}: describes the cameras {', '.join(described)}, but the images are from "
            f"{', '.join(missing)}. Give the rig of these cameras, rename its cameras, or remove its "
            "[[cameras]]"
        )
    named = ", ".join(missing)
    return [f"{where}: does not describe camera {named}; defaults are used, such as no rolling shutter"]


def example_toml() -> str:
    """Return the commented ``lab.toml`` that ``ipsys init`` writes: the lab of the paper."""
    return files("ipsys_log.messages").joinpath("lab.toml").read_text(encoding="utf-8")


def rig_toml(rig: Rig) -> str:
    """Return a rig as the text of a rig file, which :func:`load_rig` can read.

    Examples
    --------
    >>> print(rig_toml(Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(3, robot="ada"),))))
    name = "lab"
    dictionary = "DICT_4X4_100"
    marker_length_m = 0.2
    <BLANKLINE>
    [[markers]]
    id = 3
    robot = "ada"
    <BLANKLINE>
    """
    lines = toml_rows(rig)
    if rig.floor is not None:
        lines += ["", "[floor]", *toml_rows(rig.floor)]
    if rig.stream is not None:
        lines += ["", "[stream]", *toml_rows(rig.stream)]
    if rig.nodes is not None:
        lines += ["", "[nodes]", *toml_rows(rig.nodes)]
    for key in _ITEMS:
        for item in getattr(rig, key):
            lines += ["", f"[[{key}]]", *toml_rows(item)]
    return "\n".join(lines) + "\n"


def hide_passwords(rig: Rig) -> Rig:
    """Return a rig without the passwords in its cameras' sources."""
    cameras = (
        replace(camera, source=camera.source and hide_password(camera.source)) for camera in rig.cameras
    )
    return replace(rig, cameras=tuple(cameras))


def toml_rows(item: Any) -> list[str]:
    """Return the lines of an item of a rig, without the header of its table; missing values have no line."""
    values = [(f.name, getattr(item, f.name)) for f in fields(item)]
    # A JSON string is a TOML string, and a JSON number is a TOML number; so is a list of strings. JSON writes
    # some letters as pairs of escapes, which TOML refuses: they stay letters.
    return [
        f"{name} = {json.dumps(value, ensure_ascii=False)}"
        for name, value in values
        if isinstance(value, (bool, str, int, float))
        or (value and (_are_texts(value) or _are_numbers(value)))
    ]


def _are_texts(value: object) -> bool:
    return isinstance(value, (tuple, list)) and all(isinstance(text, str) for text in value)


def _are_numbers(value: object) -> bool:
    return isinstance(value, (tuple, list)) and all(
        isinstance(number, (int, float)) and not isinstance(number, bool) for number in value
    )


def load_rig(path: Path) -> Rig:
    """Read and check a rig file.

    Raises
    ------
    IpsysError
        The file cannot be read, is not TOML, has unknown or missing keys, contradicts itself, or has a value
        in a wrong unit.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise IpsysError(f"{path}: is too large for a rig file; to write one: ipsys init lab.toml")
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise IpsysError(
            f"{path}: does not exist; to write a rig file: ipsys init {shell_words(path)}"
        ) from error
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise IpsysError(
            f"{path}: is not a text file; to write a rig file: ipsys init {shell_words(path)}"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise IpsysError(_not_toml(path, error)) from error
    except (ValueError, RecursionError) as error:  # a number or nesting that Python's parser refuses
        raise IpsysError(
            f"{path}: a number has thousands of digits, or tables are nested thousands deep; "
            f"to write a rig file: ipsys init {shell_words(path.name)}"
        ) from error
    for key, item in _ITEMS.items():
        rows = table.get(key, [])
        if not isinstance(rows, list):
            raise IpsysError(f"{path}: {key} must be a list of tables, written [[{key}]]")
        table[key] = tuple(
            _build(item, row, f"{path}: [[{key}]] number {n}") for n, row in enumerate(rows, 1)
        )
    if "floor" in table:
        table["floor"] = _build(Floor, table["floor"], f"{path}: [floor]")
    if "stream" in table:
        table["stream"] = _build(RigStream, table["stream"], f"{path}: [stream]")
    if "nodes" in table:
        table["nodes"] = _build(RigNodes, table["nodes"], f"{path}: [nodes]")
    rig = check_rig(_build(Rig, table, str(path)), str(path))
    check_units(rig, str(path))
    return rig


def _not_toml(path: Path, error: tomllib.TOMLDecodeError) -> str:
    """Return the error text for a line, with hints on the most frequent mistakes."""
    text = f"{path}: is not valid TOML: {error}"
    position = re.search(r"at line (\d+)", str(error))
    lines = path.read_text(encoding="utf-8").split("\n")
    line = lines[int(position[1]) - 1].strip()[:_LONGEST_LINE] if position else ""
    if comma := re.search(r"= *(\d+),(\d+)\s*(#.*)?$", line):
        return f"{text}: {line}: write the decimal point as {comma[1]}.{comma[2]}"
    if bare := re.search(r"= *([^\s\"'\[{0-9][^#]*?)\s*(#.*)?$", line):
        return f'{text}: {line}: text needs quotes; write "{bare[1]}"'
    return f"{text}: {line}" if line else text


def check_rig(rig: Rig, where: str) -> Rig:
    """Return ``rig`` if it does not contradict itself.

    Raises
    ------
    IpsysError
        Two cameras, markers or reference points have the same name, or two reference points have the same
        position. Or a name is not valid, a length or sigma is not positive, or a height is impossible.
    """
    for camera in rig.cameras:
        check_name(camera.name, f"{where}: camera name")
    for marker in rig.markers:
        if marker.robot is not None:
            check_name(marker.robot, f"{where}: robot name")
    check_unique((camera.name for camera in rig.cameras), f"{where}: two cameras have the name")
    ids = (marker.id for marker in rig.all_markers)
    check_unique(ids, f"{where}: two markers have the id")
    check_bodies(rig, where)
    check_unique((p.name for p in rig.reference_points), f"{where}: two reference points have the name")
    markers = rig.all_markers
    lengths = [rig.marker_length_m, *(m.length_m for m in markers if m.length_m is not None)]
    if rig.floor is not None:
        lengths += [rig.floor.width_m, rig.floor.depth_m]
    for length in lengths:
        if not (math.isfinite(length) and length > 0):
            raise IpsysError(f"{where}: {length} m is not a length; marker and floor sizes must be above 0")
    _check_cameras(rig, where)
    _check_tape(rig, where)
    _check_heights(rig, where)
    if rig.stream is not None:
        _check_stream(rig.stream, rig, f"{where}: [stream]")
    for item in (rig, rig.floor, *markers, *rig.cameras, *rig.reference_points):
        _check_numbers(item, where)
    return rig


def _check_numbers(item: Any, where: str) -> None:
    """Check that an item has no impossible numbers, before they cause errors in a computation."""
    for field in fields(item) if item is not None else ():
        value = getattr(item, field.name)
        if isinstance(value, float) and not abs(value) <= _FARTHEST:
            raise IpsysError(f"{where}: {field.name} is {value:g}; give a number of at most {_FARTHEST:.0f}")


def _check_cameras(rig: Rig, where: str) -> None:
    for camera in rig.cameras:
        for key in ("width", "height", "rate_hz", "exposure_s"):
            value = getattr(camera, key)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise IpsysError(f"{where}: camera {camera.name}: {key} is {value}; it must be above 0")
        if camera.stamp not in (None, *STAMPS):
            raise IpsysError(
                f"{where}: camera {camera.name}: stamp is {camera.stamp!r}; write "
                + " or ".join(f'"{name}"' for name in STAMPS)
            )
    sources = (hide_password(camera.source) for camera in rig.cameras if camera.source)
    check_unique(sources, f"{where}: two cameras have the source")


def _check_tape(rig: Rig, where: str) -> None:
    for point in rig.reference_points:
        if not (math.isfinite(point.x_m) and math.isfinite(point.y_m)):
            raise IpsysError(
                f"{where}: reference point {point.name!r} has the coordinates {point.x_m} and {point.y_m}; "
                "give numbers in m"
            )
    # Positions are rounded to 1 mm: two nearer points are probably one point that is in the file twice.
    at_m = ((round(point.x_m, 3), round(point.y_m, 3)) for point in rig.reference_points)
    check_unique(at_m, f"{where}: two reference points are at")
    sigmas_m = {"tape_sigma_m": rig.tape_sigma_m, "marker_height_sigma_m": rig.marker_height_sigma_m}
    sigmas_m |= {"ab_sigma_m": rig.ab_sigma_m}
    sigmas_m |= {f"height_sigma_m of marker {marker.id}": marker.height_sigma_m for marker in rig.markers}
    for key, sigma_m in sigmas_m.items():
        if sigma_m is not None and not (math.isfinite(sigma_m) and sigma_m > 0):
            raise IpsysError(f"{where}: {key} = {sigma_m} m is not a standard deviation; it must be above 0")

    scale_sigma = rig.tape_scale_sigma
    if scale_sigma is not None and not 0 < scale_sigma <= LARGEST_SCALE_SIGMA:
        raise IpsysError(
            f"{where}: tape_scale_sigma = {scale_sigma} is not a relative standard deviation from 0 to "
            f"{LARGEST_SCALE_SIGMA:g}; write 0.001 for 0.1 %"
        )


def _check_heights(rig: Rig, where: str) -> None:
    heights = {"marker_height_m": rig.marker_height_m}
    heights |= {f"height_m of marker {marker.id}": marker.height_m for marker in rig.markers}
    for key, height_m in heights.items():
        if height_m is not None and not 0 <= height_m <= _HIGHEST_M:
            raise IpsysError(
                f"{where}: {key} is {height_m} m; give the height above the floor in m, 0 to {_HIGHEST_M:g}"
                + (f"; {height_m / 100:g} if it is in cm" if 0 < height_m / 100 <= _HIGHEST_M else "")
            )


def _check_stream(stream: RigStream, rig: Rig, where: str) -> None:
    for key in ("vrpn", "ros2", "foxglove"):
        port = getattr(stream, key)
        if port is not None and not 0 < port <= _LARGEST_PORT:
            raise IpsysError(f"{where}: {key} is {port}; give a port from 1024 to {_LARGEST_PORT}")
    if stream.stale_s is not None and not stream.stale_s > 0:
        raise IpsysError(f"{where}: stale_s is {stream.stale_s:g}; give a time in s above 0")
    if stream.north_rad is not None and not abs(stream.north_rad) <= 2 * math.pi:
        degrees = f"; {math.radians(stream.north_rad):.4f} if it is in degrees"
        raise IpsysError(f"{where}: north_rad is {stream.north_rad:g}; give an angle in rad{degrees}")
    check_robots(rig, stream.robots, f"{where} robots")


def check_robots(rig: Rig, robots: Collection[str], where: str) -> None:
    """Check that a rig has some robots; a rig without markers has a robot ``marker_<id>`` for each id."""
    known = {rig.robot_of(marker.id) for marker in rig.markers}
    for robot in robots:
        if robot not in known if known else not _MARKER.fullmatch(robot):
            named = (
                f"the rig has {', '.join(sorted(known))}" if known else "the rig names none: use marker_<id>"
            )
            raise IpsysError(f"{where}: robot {robot!r} is not known; {named}")


def _build(item: type[Item], row: Any, where: str) -> Item:
    """Return an ``item`` from a TOML table whose keys are its fields."""
    if not isinstance(row, Mapping):
        raise IpsysError(f"{where}: must be a table")
    known = {f.name: f for f in fields(item)}  # type: ignore[arg-type]
    unknown = sorted(set(row) - set(known))
    if unknown:
        like = get_close_matches(unknown[0], known, 1)
        meant = f"; use {like[0]}" if like else f"; known keys: {', '.join(known)}"
        raise IpsysError(f"{where}: unknown key {unknown[0]!r}{meant}")
    missing = [n for n, f in known.items() if f.default is MISSING and n not in row]
    if missing:
        raise IpsysError(f"{where}: {missing[0]} is missing; 'ipsys init' writes an example")
    hints = get_type_hints(item)
    return item(**{name: _value(hints[name], row[name], f"{where}: {name}") for name in row})


def _value(hint: Any, value: Any, where: str) -> Any:
    kind = hint.__name__ if isinstance(hint, type) else str(hint)
    if kind.startswith("float"):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise IpsysError(f"{where} must be a number, found {_shown(value)}")
        if not abs(value) <= _FARTHEST:
            raise IpsysError(f"{where} is {_shown(value)}; give a number of at most {_FARTHEST:.0f}")
        return float(value)
    if kind.startswith("int"):
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise IpsysError(f"{where} must be a whole number of at least 0, found {_shown(value)}")
        if value > (largest := _LARGEST_INT.get(where[-3:], _LARGEST_ID)):
            raise IpsysError(f"{where} is {_shown(value)}; give a whole number of at most {largest}")
    elif kind.startswith("str") and not isinstance(value, str):
        raise IpsysError(f"{where} must be text in quotes, found {_shown(value)}")
    elif kind.startswith("bool") and not isinstance(value, bool):
        raise IpsysError(f"{where} must be true or false, found {_shown(value)}")
    elif kind.startswith("tuple[float"):
        if not _are_numbers(value):
            raise IpsysError(f"{where} must be a list of numbers, such as [0.1, 0.0], found {_shown(value)}")
        return tuple(map(float, value))
    elif kind.startswith("tuple[str"):
        if not _are_texts(value):
            raise IpsysError(f'{where} must be a list of texts, such as ["a", "b"], found {_shown(value)}')
        return tuple(value)
    return value


def _shown(value: Any) -> str:
    """Return a value for an error message."""
    text = repr(value)
    return text if len(text) <= _LONGEST_LINE else f"{text[:_LONGEST_LINE]} ..."
