"""Tables of detections and calibration points come into a log with all stored digits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ipsys_log as ipsys_api
from ipsys_log import IpsysError
from ipsys_log.engine.output import write_log
from ipsys_log.exchange.import_tables import DetectionOptions, import_detections, pair_messages, read_pairs
from ipsys_log.messages import CameraCalibration, Rig, RigCamera, RigMarker
from ipsys_log.units import NS_PER_S

START_NS = 1_700_000_000 * NS_PER_S
RIG = Rig("lab", "DICT_4X4_50", 0.1, (RigMarker(1), RigMarker(7)), (RigCamera("red"), RigCamera("white")))
LENS = CameraCalibration(
    0, "red", 1920, 1080, "plumb_bob", np.zeros(5), np.array([[900.0, 0, 960], [0, 900, 540], [0, 0, 1]])
)
OPTIONS = DetectionOptions(RIG, {"red": LENS, "white": replace(LENS, frame_id="white")})
CORNERS = [f"{axis}{corner}_px" for corner in range(4) for axis in "xy"]

AXES = [f"{axis}{frame}_m" for frame in "cw" for axis in "xyz"]

numbers = st.floats(-1e6, 1e6)
lengths_m = st.floats(-1e4, 1e4)
marker_rows = st.tuples(
    st.integers(0, 5), st.sampled_from(["red", "white"]), st.integers(0, 49),
    st.lists(numbers, min_size=8, max_size=8), st.none() | st.integers(-(10**9), 10**9),
)  # fmt: skip
pair_rows = st.dictionaries(
    st.tuples(st.sampled_from(["p1", "p2", "p3 ä"]), st.sampled_from(["red", "white"])),
    st.lists(lengths_m, min_size=3, max_size=3),
    min_size=1,
)


@pytest.mark.slow
@settings(max_examples=10)
@given(rows=st.lists(marker_rows, min_size=1, unique_by=lambda row: row[:3]))
def test_imported_detections_export_the_same_table(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[int, str, int, list[float], int | None]]
) -> None:
    folder = tmp_path_factory.mktemp("detections")
    table = pd.DataFrame(
        [
            {
                "time": f"2023-11-14T22:13:2{second}.123456789Z",
                "log_time_ns": START_NS + second * NS_PER_S + 5,
                "camera": camera,
                "marker_id": marker_id,
                **dict(zip(CORNERS, corners, strict=True)),
                "time_offset_ns": offset_ns,
            }
            for second, camera, marker_id, corners, offset_ns in rows
        ]
    ).astype({"time_offset_ns": "Int64"})
    table.to_csv(folder / "a.csv", index=False)
    import_detections(folder / "a.csv", None, folder / "a.mcap", OPTIONS)
    with ipsys_api.open(folder / "a.mcap") as log:
        log.export(folder / "b.csv", "markers")
    keys = ["log_time_ns", "camera", "marker_id"]
    expected = table.sort_values(keys).reset_index(drop=True)
    exported = pd.read_csv(folder / "b.csv", dtype={"time_offset_ns": "Int64"}).sort_values(keys)
    pd.testing.assert_frame_equal(
        exported[list(expected)].reset_index(drop=True), expected, check_exact=True, check_dtype=False
    )
    for path in folder.iterdir():
        path.unlink()


@settings(max_examples=10)
@given(rows=pair_rows, world=st.lists(st.lists(lengths_m, min_size=3, max_size=3), min_size=3, max_size=3))
def test_imported_pairs_export_the_same_table(
    tmp_path_factory: pytest.TempPathFactory,
    rows: dict[tuple[str, str], list[float]],
    world: list[list[float]],
) -> None:
    folder = tmp_path_factory.mktemp("pairs")
    world_m = dict(zip(["p1", "p2", "p3 ä"], world, strict=True))
    # Two pairs with equal points are refused.
    rows = {
        key: [value / 1e3 + number for value in point] for number, (key, point) in enumerate(rows.items())
    }
    table = pd.DataFrame(
        [
            {
                "camera": camera, "id": name, "marker_id": 7,
                **dict(zip(AXES, [*point, *world_m[name]], strict=True)),
                "splits": "train train_10", "calibration_point": "floor 3",
            }
            for (name, camera), point in rows.items()
        ]
    )  # fmt: skip
    table.to_csv(folder / "a.csv", index=False)
    pairs = read_pairs(folder / "a.csv", RIG)
    write_log(folder / "a.mcap", pair_messages(pairs, folder / "a.csv", RIG))
    with ipsys_api.open(folder / "a.mcap") as log:
        log.export(folder / "b.csv", "pairs")
    keys = ["camera", "id"]
    expected = table.sort_values(keys).reset_index(drop=True)
    exported = pd.read_csv(folder / "b.csv").sort_values(keys).reset_index(drop=True)
    assert (exported.pop("frames") == 1).all()
    pd.testing.assert_frame_equal(exported[list(expected)], expected, check_exact=True)
    for path in folder.iterdir():
        path.unlink()


HEADER = "time,camera,marker_id," + ",".join(CORNERS)
ROW = "2023-11-14T22:13:20Z,red,1,0,0,1,0,1,1,0,1"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is empty"),
        (HEADER, "has no rows"),
        ("time,camera\n1,red", "has no column marker_id, x0_px"),
        (f"{HEADER},x0_px\n{ROW},3", "has the column x0_px twice"),
        (f"{HEADER}\n{ROW}\n{ROW}", "line 3: marker 1 is in this frame of red already"),
        (f"{HEADER}\n{ROW.replace('red', 'blue')}", "line 2: camera 'blue' has no intrinsics"),
        (f"{HEADER}\n{ROW.replace('red', '../a')}", "line 2: camera name '../a' must be"),
        (f"{HEADER}\n{ROW},5", "line 2: has 12 cells"),
        (f"{HEADER}\n{ROW[:-1]}nan", "line 2: y3_px: 'nan' is not a number"),
        (f"{HEADER}\n{ROW.replace('2023', 'x')}", "line 2: time: 'x-11-14T22:13:20Z' is not a time"),
        (f"{HEADER}\n{ROW.replace('red,1', 'red,1.5')}", "line 2: marker_id: '1.5' is not an integer"),
        (f"{HEADER}\n{ROW.replace('red,1', 'red,-1')}", "line 2: marker_id -1 is not the id of a marker"),
        ("\0\n\0", "is not a text file|has no column"),
    ],
)
def test_faulty_detections_are_one_line(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    with pytest.raises(IpsysError, match=reason):
        import_detections(tmp_path / "a.csv", None, tmp_path / "a.mcap", OPTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


PAIR_HEADER = "id,camera,xc_m,yc_m,zc_m,xw_m,yw_m,zw_m,marker_id"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (PAIR_HEADER, "has no rows"),
        (f"{PAIR_HEADER}\n,red,0,0,2,1,1,0,1", "line 2: id is empty"),
        (f"{PAIR_HEADER}\na,red,0,0,2,1,1,0,", "line 2: names no marker"),
        (f"{PAIR_HEADER}\na,red,0,0,2,1,1,0,3", "line 2: marker 3 is not in the rig"),
        (
            f"{PAIR_HEADER}\na,red,0,0,2,1,1,0,1\na,white,0,0,2,1,1,1,1",
            "line 3: .* has another marker, world",
        ),
        (
            f"{PAIR_HEADER}\na,red,0,0,2,1,1,0,1\na,red,0,0,2,1,1,0,1",
            "line 3: .* a row of camera red already",
        ),
    ],
)
def test_faulty_pairs_are_one_line(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    with pytest.raises(IpsysError, match=reason):
        read_pairs(tmp_path / "a.csv", RIG)
