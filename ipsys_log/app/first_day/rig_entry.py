"""Typed fields of a rig with their faults, and changes of the rig file that keep its other lines."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.messages import Floor, ReferencePoint, Rig, RigMarker
from ipsys_log.messages.rig_checks import check_units
from ipsys_log.messages.rig_file import check_rig, example_toml, load_rig, toml_rows
from ipsys_log.stages.detect.search import marker_detector

_FILE = "lab.toml"
_USUAL = ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 1.0, 0.0)
_LONGEST_FIELD = 200
# Larger factors from an error of the tape to an error of the position are worth a warning.
_MOST_GROWTH = 6.0
# No tape differs from the distance AB of the coordinates by more than this share of it.
_FAR_FROM_AB = 0.05
# The fields of the form: key, label.
_PLACED = ("first_x_m", "first_y_m", "second_x_m", "second_y_m")
LABELS = {
    "name": "Name of the lab",
    "dictionary": "Dictionary of the markers",
    "marker_length_m": "Side of the black square, in m",
    "robots": "Marker ids of robots: 0, 1, 2",
    "marker_height_m": "Height of their markers above the floor, in m",
    "point_marker": "Marker id for calibration points, on no robot",
    "width_m": "Floor width, in m",
    "depth_m": "Floor depth, in m",
    "first_x_m": "Point A: x, in m",
    "first_y_m": "Point A: y, in m",
    "second_x_m": "Point B: x, in m",
    "second_y_m": "Point B: y, in m",
    "ab_m": "Distance from A to B by the tape, in m",
}
_NUMBERS = [key for key in LABELS if key.endswith("_m")]
# An empty field of these has no value.
_OPTIONAL = re.compile(r"marker_height_m|point_marker|ab_m|height_\d{1,4}")
_HEIGHT = re.compile(r"height_(\d{1,4})")


def example_rig() -> Rig:
    """Return the rig of the example that ``ipsys init`` writes."""
    with TemporaryDirectory(prefix="ipsys-") as folder:
        path = Path(folder) / _FILE
        path.write_text(example_toml(), encoding="utf-8")
        return load_rig(path)


def rig_fields(rig: Rig) -> dict[str, str]:
    """Return the text of each field for a rig, ``height_0`` for marker 0 alone; "" for a missing value."""
    first, second = (*rig.reference_points[:2], *_USUAL[len(rig.reference_points) :])
    values: dict[str, Any] = {
        "name": rig.name,
        "dictionary": rig.dictionary,
        "marker_length_m": rig.marker_length_m,
        "robots": ", ".join(str(marker.id) for marker in rig.markers if marker.robot),
        "marker_height_m": rig.marker_height_m,
        "point_marker": next((marker.id for marker in rig.markers if not marker.robot), None),
        "width_m": rig.floor.width_m if rig.floor else "",
        "depth_m": rig.floor.depth_m if rig.floor else "",
        "first_x_m": first.x_m,
        "first_y_m": first.y_m,
        "second_x_m": second.x_m,
        "second_y_m": second.y_m,
        "ab_m": math.hypot(second.x_m - first.x_m, second.y_m - first.y_m),
        **{f"height_{marker.id}": marker.height_m for marker in rig.markers if marker.robot},
    }
    return {key: _text(value) for key, value in values.items()}


def _text(value: Any) -> str:
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def check_rig_entry(typed: Mapping[str, str], rig: Rig) -> tuple[Rig | None, list[Fault]]:
    """Return the typed rig, or the faults of its fields in the words of the rig file.

    Parameters
    ----------
    typed : texts by field; a missing field keeps the value of ``rig``. A typed ``ab_m`` moves point B.
    rig : the present rig; its cameras, its other markers and its other reference points stay.
    """
    present = {**rig_fields(rig), "ab_m": ""}
    present |= {key: "" for key in typed if _HEIGHT.fullmatch(key) and key not in present}
    texts = {key: typed.get(key, text).strip()[:_LONGEST_FIELD] for key, text in present.items()}
    faults: list[Fault] = []
    values: dict[str, Any] = {}
    for key, text in texts.items():
        try:
            values[key] = _value(key, text)
            _check_alone(key, values[key], values.get("dictionary", rig.dictionary))
        except IpsysError as error:
            faults.append(Fault(key, _without_key(str(error))))
    # The valid fields are checked together, beside the present values: one answer names all faults.
    wrong = {fault.field for fault in faults}
    kept = {
        key: _value(key, text)
        for key, text in present.items()
        if key in wrong and (text or _OPTIONAL.fullmatch(key))
    }
    new = None if wrong - set(kept) else _build({**values, **kept}, rig)
    if new is not None:
        faults += [fault for fault in _check_together(new, values) if fault.field not in wrong]
    return (None, faults) if faults else (new, [])


def _check_together(rig: Rig, values: Mapping[str, Any]) -> list[Fault]:
    """Return the fault of values that contradict each other."""
    if values.get("point_marker") in values.get("robots", ()):
        return [Fault("point_marker", "this marker is on a robot; choose another id")]
    if all(values.get(key) is not None for key in _PLACED) and values.get("ab_m"):
        apart_m = math.hypot(*(values[f"second_{axis}_m"] - values[f"first_{axis}_m"] for axis in "xy"))
        if abs(values["ab_m"] - apart_m) > _FAR_FROM_AB * apart_m:
            return [Fault("ab_m", f"the coordinates of A and B give {apart_m:.3f} m; correct them, or this")]
    try:
        check_rig(rig, _FILE)
        check_units(rig, _FILE)
    except IpsysError as error:
        text = _without_key(str(error))
        return [Fault("second_x_m" if "reference points" in text else "robots", text)]
    return []


def _without_key(text: str) -> str:
    """Return the text of an error beside its field, which has a label: without the key of the rig file."""
    return re.sub(r"^(lab\.toml: )?(\[floor\] |reference point A: )?(\w+_m = )?", "", text)


def rig_warnings(rig: Rig) -> list[str]:
    """Return warnings on missing heights, and on reference points that give poor positions."""
    points, floor = rig.reference_points, rig.floor
    warnings = []
    if any(not height_m for height_m in rig.robot_heights_m().values()):
        warnings.append(
            "the height of the robots' markers is missing: without it, a drive cannot calibrate the lab"
        )
    if floor is None or len(points) < len(_USUAL):
        return warnings
    warnings += [
        f"reference point {point.name} is outside the floor"
        for point in points
        if not (0 <= point.x_m <= floor.width_m and 0 <= point.y_m <= floor.depth_m)
    ]
    apart_m = max(math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) for a, b in combinations(points, 2))
    # Two circles of radius r around points at a distance b cross at an angle of about b / r.
    growth = math.hypot(floor.width_m, floor.depth_m) / apart_m
    if growth > _MOST_GROWTH:
        warnings.append(
            f"the reference points are {apart_m:.2f} m apart: far from them, an error of the tape grows by a "
            f"factor of up to {growth:.0f}; choose them further apart"
        )
    return warnings


def save_rig_entry(path: Path, typed: Mapping[str, str]) -> list[Fault]:
    """Write a typed rig into the rig file, which is made if it does not exist; return faults instead."""
    text = path.read_text(encoding="utf-8") if path.exists() else example_toml()
    old = load_rig(path) if path.exists() else example_rig()
    new, faults = check_rig_entry(typed, old)
    if new is None:
        return faults
    keys = ("name", "dictionary", "marker_length_m", "marker_height_m")
    values = {key: getattr(new, key) for key in keys}
    text = replace_values(text, values)
    for header, key in (("[[markers]]", "markers"), ("[[reference_points]]", "reference_points")):
        if getattr(new, key) != getattr(old, key):
            text = replace_tables(text, header, getattr(new, key))
    if new.floor != old.floor:
        text = replace_tables(text, "[floor]", [new.floor])
    write_rig(path, text, new)
    return []


def _value(key: str, text: str) -> Any:
    """Return the value of a field; an empty text, or one that is no number, is an error."""
    if key == "robots":
        return [_marker_id(part) for part in re.split(r"[,;\s]+", text) if part]
    if not text and _OPTIONAL.fullmatch(key):
        return None
    if key == "point_marker":
        return _marker_id(text)
    if not text:
        raise IpsysError("the field is empty; type a value")
    if key not in _NUMBERS and not _HEIGHT.fullmatch(key):
        return text
    try:
        # A field has one number: a comma is its decimal point, as on the measuring page.
        return float(re.sub(r"^(-?\d+),(\d+)$", r"\1.\2", text))
    except ValueError as error:
        raise IpsysError(f"{text} is not a number; write 0.2, for example") from error


def _marker_id(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= len("9999")):
        raise IpsysError(f"marker id {text} is not a number; write the ids as 0, 1, 2")
    return int(text)


def _check_alone(key: str, value: Any, dictionary: str) -> None:
    """Check one value in a rig without the others: it is possible, and has the unit of its field."""
    rig = Rig("lab", "DICT_4X4_100", 0.2)
    if key == "dictionary":
        marker_detector(value)
    if value is None:
        return
    if _HEIGHT.fullmatch(key):
        key = "marker_height_m"
    field = key.removeprefix("first_").removeprefix("second_")
    changed: dict[str, Callable[[], Rig]] = {
        "marker_length_m": lambda: replace(rig, marker_length_m=value),
        "marker_height_m": lambda: replace(rig, marker_height_m=value),
        "ab_m": lambda: replace(rig, floor=Floor(value, 1.0)),
        "point_marker": lambda: replace(rig, dictionary=dictionary, markers=(RigMarker(value),)),
        "width_m": lambda: replace(rig, floor=Floor(value, 1.0)),
        "depth_m": lambda: replace(rig, floor=Floor(1.0, value)),
        "x_m": lambda: replace(rig, reference_points=(ReferencePoint("A", value, 0.0),)),
        "y_m": lambda: replace(rig, reference_points=(ReferencePoint("A", 0.0, value),)),
        "robots": lambda: replace(
            rig, dictionary=dictionary, markers=tuple(RigMarker(marker_id) for marker_id in value)
        ),
    }
    if field in changed:
        check_rig(changed[field](), _FILE)
        check_units(changed[field](), _FILE)


def _build(values: Mapping[str, Any], rig: Rig) -> Rig:
    points = (*rig.reference_points[:2], *_USUAL[len(rig.reference_points) :])
    placed = [
        replace(point, x_m=values[f"{order}_x_m"], y_m=values[f"{order}_y_m"])
        for order, point in zip(("first", "second"), points, strict=True)
    ]
    if values["ab_m"]:
        placed[1] = _at_distance(placed[0], placed[1], values["ab_m"])
    return replace(
        rig,
        name=values["name"],
        dictionary=values["dictionary"],
        marker_length_m=values["marker_length_m"],
        marker_height_m=values["marker_height_m"],
        floor=Floor(values["width_m"], values["depth_m"]),
        reference_points=(*placed, *rig.reference_points[2:]),
        markers=tuple(_markers(values, rig)),
    )


def _at_distance(first: ReferencePoint, second: ReferencePoint, apart_m: float) -> ReferencePoint:
    """Return the second point, moved along the line from the first one to a distance, to 0.1 mm."""
    step_m = second.x_m - first.x_m, second.y_m - first.y_m
    grown = apart_m / (math.hypot(*step_m) or 1.0)
    return replace(
        second, x_m=round(first.x_m + grown * step_m[0], 4), y_m=round(first.y_m + grown * step_m[1], 4)
    )


def _markers(values: Mapping[str, Any], rig: Rig) -> Iterator[RigMarker]:
    """Yield the markers of the robots, then the others; the first of them is for calibration points."""
    known = {marker.id: marker for marker in rig.markers}
    robots = dict.fromkeys(values["robots"])
    for marker_id in robots:
        marker = known.get(marker_id, RigMarker(marker_id))
        height_m = values.get(f"height_{marker_id}", marker.height_m)
        yield replace(marker, robot=marker.robot or f"robot_{marker_id}", height_m=height_m)
    others = [marker for marker in rig.markers if marker.id not in robots and not marker.robot]
    point_id = values["point_marker"]
    if point_id not in [marker.id for marker in others[:1]]:
        point = [] if point_id is None else [known.get(point_id, RigMarker(point_id, height_m=0.0))]
        others = [*point, *(marker for marker in others[1:] if marker.id != point_id)]
    # Without ids of robots, all ids count: a single listed marker would be the only one.
    if robots or [marker.id for marker in others] != [point_id]:
        yield from others


_HEADER = re.compile(r"\s*\[{1,2}\s*([A-Za-z_]+)\s*\]{1,2}")


@dataclass(slots=True)
class _Block:
    """A table of a rig file: the comments before it, its key ("" for the first lines), and its lines."""

    lead: list[str]
    key: str
    lines: list[str] = field(default_factory=list)


def replace_values(text: str, values: Mapping[str, str | float | None]) -> str:
    """Return a rig file with other values at its top, such as ``name``; lines of comments stay.

    The line of a value None is removed.

    Examples
    --------
    >>> print(replace_values('name = "lab"  # ours', {"name": "hall"}), end="")
    name = "hall"
    """
    blocks = _split(text)
    lines = blocks[0].lines
    removed = [key for key, value in values.items() if value is None]
    lines[:] = [line for line in lines if not any(re.match(rf"\s*{key}\s*=", line) for key in removed)]
    for row in _toml_rows_of(values):
        key = row.partition(" ")[0]
        number = next((n for n, line in enumerate(lines) if re.match(rf"\s*{key}\s*=", line)), None)
        if number is None:
            lines.append(row)
        else:
            lines[number] = row
    return _join(blocks)


def _toml_rows_of(values: Mapping[str, str | float | None]) -> list[str]:
    """Return the lines of values at the top of a rig file."""
    rig = Rig(**{"name": "", "dictionary": "", "marker_length_m": 0.0, **values})  # type: ignore[arg-type]
    return [row for row in toml_rows(rig) if row.partition(" ")[0] in values]


def replace_tables(text: str, header: str, items: Sequence[Any]) -> str:
    """Return a rig file with other tables of one kind, at the place of the first old one, else at the end.

    Parameters
    ----------
    header : the line before each table, such as ``[[cameras]]``.
    items : the new tables, as parts of a rig.
    """
    match = _HEADER.match(header)
    assert match is not None
    key, blocks = match[1], _split(text)
    old = [block for block in blocks if block.key == key]
    place = blocks.index(old[0]) if old else len(blocks)
    lead = [line for block in old for line in block.lead if line.strip()]
    new = [_Block([""], key, [header, *toml_rows(item)]) for item in items]
    if new:
        new[0].lead = ["", *lead]
    kept = [block for block in blocks[:place] if block.key != key]
    return _join([*kept, *new, *(block for block in blocks[place:] if block.key != key)])


def write_rig(path: Path, text: str, expected: Rig) -> None:
    """Write a changed rig file if it means the expected rig.

    Raises
    ------
    IpsysError
        The rig has a fault, or the file has a layout that these changes do not understand.
    """
    with TemporaryDirectory(prefix="ipsys-") as folder:
        draft = Path(folder) / path.name
        draft.write_text(text, encoding="utf-8")
        try:
            rig = load_rig(draft)
        except IpsysError as error:
            raise IpsysError(str(error).replace(str(draft), path.name)) from error
    if rig != expected:
        raise IpsysError(f"{path.name}: its layout is unusual; edit it in a text editor")
    with replacement_of(path) as file:
        file.write(text.encode())


def _split(text: str) -> list[_Block]:
    """Divide a rig file into its tables; comments after a blank line belong to the next table."""
    blocks = [_Block([], "")]
    for line in text.splitlines():
        header = _HEADER.match(line)
        if header is None:
            blocks[-1].lines.append(line)
            continue
        lead = _take_comments(blocks[-1].lines)
        blocks.append(_Block(lead, header[1], [line]))
    return blocks


def _take_comments(lines: list[str]) -> list[str]:
    """Remove and return the comments at the end of a table, from the first blank line after its values on."""
    last = max((n for n, line in enumerate(lines) if line.strip() and line.lstrip()[0] != "#"), default=-1)
    blank = next((n for n in range(last + 1, len(lines)) if not lines[n].strip()), len(lines))
    lead = lines[blank:]
    del lines[blank:]
    return lead


def _join(blocks: Sequence[_Block]) -> str:
    lines = [line for block in blocks for line in (*block.lead, *block.lines)]
    return "\n".join(lines).strip("\n") + "\n"
