"""Files of motion capture systems: their head lines name the bodies, the units, the rate and the axes."""

import re
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice, pairwise, takewhile
from pathlib import Path

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.row_files import find_delimiter, with_decimal_point
from ipsys_log.exchange.trajectory_columns import UNITS, GivenUnits
from ipsys_log.exchange.trajectory_tables import (
    ANGLE_UNITS,
    LENGTH_UNITS,
    BodyColumns,
    Layout,
    Reading,
    Row,
    encoding_of,
    make_trajectory,
    read_poses,
    split_rows,
    z_up,
)
from ipsys_log.extras import check_installed
from ipsys_log.plain_text import join_names
from ipsys_log.units import NS_PER_S

_HEAD_BYTES = 1 << 16
# Bodies are read; single markers only if there are no bodies, or if they are selected by name.
_MOTIVE_RANKS = {"Rigid Body": 0, "Bone": 1, "Marker": 2, "Rigid Body Marker": 3, "Bone Marker": 3}
_VICON_RANKS = {"objects": 0, "segments": 1, "trajectories": 2}
_VICON_NAME = re.compile(r"(?:Global Angle\s*)?(?:\((?:Euler)?(?P<form>\w+)\)\s*)?(?P<name>.*)")
_QUALISYS_KEY = re.compile(r"[A-Z][A-Z_0-9]{3,}( .*)?")
_QUALISYS_BODY = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{n}]" for n in range(9))]
_Offer = tuple[int, BodyColumns]


def read_motion_capture(path: Path, wanted: Sequence[str], units: GivenUnits) -> Reading | None:
    """Read a table of Motive, Vicon or Qualisys, or a TRC file; None if it is none of them.

    Parameters
    ----------
    wanted : names of single markers to read beside the bodies.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).decode(encoding_of(path), errors="replace")
    first = next((line for line in head.splitlines() if line.strip(" ;,\t")), "")
    word = re.split(r"[,;\t]", first)[0].strip().lower()
    if word == "format version":
        return _read_motive(path, _filled(split_rows(path, find_delimiter(first))), wanted, units)
    if word in (*_VICON_RANKS, "model outputs", "devices"):
        return _read_vicon(path, split_rows(path, find_delimiter(head)), wanted)
    if word in ("no_of_frames", "file_version"):
        return _read_qualisys(path, _filled(split_rows(path, "\t")))
    if word == "pathfiletype":
        return _read_trc(path, _filled(split_rows(path, "\t" if "\t" in first else None)), units)
    return None


def _read_motive(path: Path, rows: Iterator[Row], wanted: Sequence[str], units: GivenUnits) -> Reading:
    head: list[list[str]] = []
    for _, cells in rows:
        head.append(cells)
        if cells[0].lower() == "frame":
            break
    about = dict(zip(head[0][::2], head[0][1::2], strict=False))
    kinds_at = next((n for n, cells in enumerate(head) if {*cells} & _MOTIVE_RANKS.keys()), 0)
    if not kinds_at or len(head) < kinds_at + 4 or head[-1][0].lower() != "frame":
        raise IpsysError(f"{path}: names no rigid bodies or markers; export it from Motive with its header")
    # Below the kinds are the names, identifiers, in Motive 3 the parents, and last the parts of the poses.
    kinds, names, parts, axes = head[kinds_at], head[kinds_at + 1], head[-2], head[-1]
    ids = next((cells for cells in head[kinds_at:] if cells[1:2] == ["ID"]), names)
    groups: dict[tuple[str, ...], dict[str, dict[str, int]]] = defaultdict(lambda: defaultdict(dict))
    for place, (*group, part, axis) in enumerate(zip(kinds, names, ids, parts, axes, strict=False)):
        if group[0] in _MOTIVE_RANKS:
            groups[tuple(group)][part][axis] = place
    unit, per_m = _length(path, about.get("Length Units", ""), units)
    order = about.get("Rotation Type", "").upper()
    offers = []
    for (kind, name, _), columns in groups.items():
        turn, form, per_rad = _places(columns["Rotation"], "XYZW"), "quaternion", 1.0
        if not turn and sorted(order) == ["X", "Y", "Z"]:
            turn, form, per_rad = _places(columns["Rotation"], order), order, ANGLE_UNITS["deg"]
        if point := _places(columns["Position"], "XYZ"):
            body = BodyColumns(name, point, (per_m,) * 3, turn, form, (per_rad,))
            offers.append((_MOTIVE_RANKS[kind], body))
    rate, start = about.get("Export Frame Rate", ""), about.get("Capture Start Time", "")
    kind = _about(f"Motive CSV {about.get('Format Version', '')}", rate, start)
    layout = Layout((), (1,), NS_PER_S, is_y_up=True)
    return _read_offers(path, rows, offers, wanted, layout, kind, unit)


def _read_vicon(path: Path, rows: Iterator[Row], wanted: Sequence[str]) -> Reading:
    found: tuple[int, Reading] | None = None
    sections = []
    while section := next((cells[0].strip() for _, cells in rows if "".join(cells).strip()), ""):
        sections.append(section)
        rank = _VICON_RANKS.get(section.lower())
        # A section ends with an empty line.
        block = takewhile(lambda row: any(cell.strip() for cell in row[1]), rows)
        if rank is not None and (found is None or rank < found[0]):
            found = rank, _read_section(path, section, block, wanted)
        for _ in block:
            pass
    if found is None:
        raise IpsysError(
            f"{path}: has the sections {', '.join(sections)}; export Objects, Segments or Trajectories"
        )
    return found[1]


def _read_section(path: Path, section: str, rows: Iterator[Row], wanted: Sequence[str]) -> Reading:
    head = [[cell.strip() for cell in cells] for _, cells in islice(rows, 4)]
    if len(head) < 4 or head[2][0].lower() != "frame":
        raise IpsysError(f"{path}: {section} have no rate, names, axes and units; export them again")
    width = max(len(cells) for cells in head)
    (rate, *_), names, axes, units = ([*cells, *[""] * (width - len(cells))] for cells in head)
    offers, unit = [], ""
    starts = [place for place, name in enumerate(names) if name]
    for start, end in pairwise([*starts, width]):
        columns = {axes[place]: place for place in range(start, end)}
        point = _places(columns, ("TX", "TY", "TZ")) or _places(columns, "XYZ")
        if not point:
            continue
        unit, per_m = _length(path, units[point[0]], GivenUnits())
        match = _VICON_NAME.fullmatch(names[start])
        assert match is not None
        turn, form, per_rad = _places(columns, ("RX", "RY", "RZ", "RW")), "quaternion", 1.0
        if not turn and (vector := _places(columns, ("RX", "RY", "RZ"))):
            # Vicon writes the axis times the angle ("helical"), unless the name has an order of angles.
            order = (match["form"] or "").upper()
            is_order = sorted(order) == ["X", "Y", "Z"]
            form = order if is_order else "vector"
            turn = tuple(vector["XYZ".index(axis)] for axis in order) if is_order else vector
            angle = units[vector[0]] or "rad"
            if (per_rad := ANGLE_UNITS.get(UNITS.get(angle.lower(), angle), 0.0)) == 0:
                raise IpsysError(
                    f"{path}: the rotation of {names[start]} has the unit {angle!r}, not rad or deg"
                )
        subject, _, part = match["name"].partition(":")
        name = subject if part in ("", subject) else match["name"]
        offers.append((0, BodyColumns(name, point, (per_m,) * 3, turn, form, (per_rad,))))
    layout = Layout((), (0,), rate_hz=_rate(path, rate), first=1)
    kind = _about(f"Vicon CSV ({section.lower()})", rate, "")
    return _read_offers(path, rows, offers, wanted, layout, kind, unit)


def _read_qualisys(path: Path, rows: Iterator[Row]) -> Reading:
    about: dict[str, list[str]] = {}
    first: Row = (0, [""])
    for first in rows:
        if not _QUALISYS_KEY.fullmatch(first[1][0]):
            break
        about[first[1][0]] = [cell for cell in first[1][1:] if cell]
    names = about.get("BODY_NAMES") or about.get("MARKER_NAMES") or []
    own = _QUALISYS_BODY if "BODY_NAMES" in about else ["X", "Y", "Z"]
    header = first[1] if any(cell.split()[-1:] == ["X"] for cell in first[1]) else []
    width = len(first[1]) - (not first[1][-1])
    before = 2 if header[:1] == ["Frame"] else 0 if header else width % len(own)
    step = (width - before) // max(len(names), 1)
    if not names or not step or before not in (0, 2) or not about.get("FREQUENCY"):
        raise IpsysError(f"{path}: its head and its columns do not agree; export it again from QTM")
    offers = []
    for start, name in zip(range(before, width, step), names, strict=False):
        texts = [text.split()[-1] for text in header[start : start + step] if text] or own
        columns = {text: start + n for n, text in enumerate(texts)}
        # The elements are numbered by the columns of the matrix.
        turn = _places(columns, [f"Rot[{3 * column + row}]" for row in range(3) for column in range(3)])
        if point := _places(columns, "XYZ"):
            offers.append((0, BodyColumns(name, point, (LENGTH_UNITS["mm"],) * 3, turn, "matrix")))
    rate, start_time = about["FREQUENCY"][0], "".join(about.get("TIME_STAMP", [])[:1])
    layout = Layout((), (1,), NS_PER_S) if before else Layout((), rate_hz=_rate(path, rate))
    rows = rows if header else chain([first], rows)
    kind = _about(f"Qualisys TSV {'6D' if 'BODY_NAMES' in about else '3D'}", rate, start_time)
    return _read_offers(path, rows, offers, (), layout, kind, "mm")


def _read_trc(path: Path, rows: Iterator[Row], units: GivenUnits) -> Reading:
    head = [cells for _, cells in islice(rows, 4)]
    if len(head) < 4 or not head[3][0].lower().startswith("frame"):
        raise IpsysError(f"{path}: has no rate, units and names of markers; export the TRC file again")
    about = dict(zip(head[1], head[2], strict=False))
    names = [(place, re.sub(r"_X$", "", name)) for place, name in enumerate(head[3]) if place > 1 and name]
    unit, per_m = _length(path, about.get("Units", ""), units)
    # Each name is above the first of three columns; some programs write one for each column.
    offers = [
        (0, BodyColumns(name, (place, place + 1, place + 2), (per_m,) * 3))
        for place, name in names
        if (place - 2) % 3 == 0
    ]
    rows = (row for row in rows if row[1][0])  # without the row X1 Y1 Z1
    kind, layout = _about("TRC", about.get("DataRate", ""), ""), Layout((), (1,), NS_PER_S)
    return _read_offers(path, rows, offers, (), layout, kind, unit)


def read_c3d(path: Path, units: GivenUnits) -> Reading:
    """Read the markers of a C3D file."""
    check_installed("C3D files need", "c3d")
    import c3d

    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files without analog channels
            reader = c3d.Reader(file)
            names = [name.strip() for name in reader.point_labels]
            about = {
                name: parameter.string_value.strip()
                for name in ("UNITS", "Y_SCREEN")
                if (parameter := reader.get(f"POINT:{name}")) is not None
            }
            rate = str(reader.point_rate)
            frames = [(number, points[:, :4]) for number, points, _ in reader.read_frames()]
            count = reader.last_frame - reader.first_frame + 1
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    # The library checks little: bytes that are no C3D file raise about ten types of errors.
    except Exception as error:
        raise IpsysError(f"{path}: is not a readable C3D file ({error}); export it again") from error
    if not frames:
        raise IpsysError(f"{path}: has none of its {count} frames; export it again")
    rate_hz = _rate(path, rate)
    unit, per_m = _length(path, about.get("UNITS", ""), units)
    is_y_up = about.get("Y_SCREEN", "").upper() == "+Y"
    times_ns = np.array([round((n - 1) * NS_PER_S / rate_hz) for n, _ in frames], dtype=np.int64)
    rows = np.array([points for _, points in frames], dtype=np.float64)
    rows[rows[:, :, 3] < 0] = np.nan  # the residual of a marker that was not seen
    points_m = [rows[:, place, :3] / per_m for place in range(rows.shape[1])]
    made = [
        make_trajectory(f"{path}", name, times_ns, z_up(points) if is_y_up else points, None)
        for name, points in zip(names, points_m, strict=False)
        if name and np.isfinite(points).all(axis=1).any()
    ]
    said = [f"markers in {unit}", "y is up, turned to z up" if is_y_up else "axes as in the file"]
    remarks = (f"{path.name}: has only {len(frames)} of its {count} frames",) if len(frames) < count else ()
    return Reading(made, _about("C3D", rate, ""), said, remarks)


def _filled(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield the rows with text, without blanks around their cells."""
    for line, cells in rows:
        if any(cell.strip() for cell in cells):
            yield line, [cell.strip() for cell in cells]


def _places(columns: Mapping[str, int], names: Sequence[str]) -> tuple[int, ...]:
    """Return the columns of some names; empty if one is missing."""
    return tuple(columns[name] for name in names) if columns.keys() >= {*names} else ()


def _read_offers(
    path: Path,
    rows: Iterator[Row],
    offers: Sequence[_Offer],
    wanted: Sequence[str],
    layout: Layout,
    kind: str,
    unit: str,
) -> Reading:
    """Read the bodies of the first rank, and those that are wanted."""
    best = min((rank for rank, _ in offers), default=None)
    if best is None:
        raise IpsysError(f"{path}: has no body with a position; export positions, too")
    bodies: dict[str, BodyColumns] = {}
    for rank, body in sorted(offers, key=lambda offer: offer[0]):
        # Motive numbers neither bodies nor markers of the same name.
        name = body.name if rank > best or body.name not in bodies else f"{body.name} ({len(bodies)})"
        if rank == best or body.name in wanted:
            bodies.setdefault(name, replace(body, name=name))
    others = [body.name for _, body in offers if body.name not in bodies]
    forms = sorted({body.form if body.turn else "none" for body in bodies.values()})
    said = [f"position in {unit}", f"rotation: {' or '.join(forms)}"]
    said += ["y is up, turned to z up" if layout.is_y_up else "axes as in the file"]
    said += [f"not read, but selectable: {join_names(others, 4)}"] * bool(others)
    layout = replace(layout, bodies=tuple(bodies.values()), is_zero_lost=True)
    return Reading(read_poses(path, rows, layout), kind, said)


def _length(path: Path, text: str, given: GivenUnits) -> tuple[str, float]:
    unit = UNITS.get(text.lower()) or given.length
    if unit not in LENGTH_UNITS:
        raise IpsysError(f"{path}: the head names no unit of length ({text or 'empty'}); add --length-unit m")
    return unit, LENGTH_UNITS[unit]


def _rate(path: Path, text: str) -> float:
    try:
        rate_hz = float(with_decimal_point(text))
    except ValueError:
        rate_hz = 0.0
    if not 0.01 < rate_hz < 1e6:
        raise IpsysError(f"{path}: the rate {text!r} is not one in Hz; export the column of times, too")
    return rate_hz


def _about(kind: str, rate: str, start: str) -> str:
    texts = [kind.strip(), f"{float(rate):g} Hz" if re.fullmatch(r"\d+\.?\d*", rate) else "", start]
    return ", ".join(text for text in texts if text)
