"""Markers and boards on paper: a PDF is rendered and measured in a simulated camera."""

from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ipsys_log.calibration.board import parse_board
from ipsys_log.calibration.board_detection import find_board
from ipsys_log.vision.markers import cell_outlines, white_cells
from tests.conftest import Ipsys

DPI = 300
PX_PER_MM = DPI / 25.4
Grey = NDArray[np.uint8]


def rendered(path: Path, dpi: float = DPI) -> list[Grey]:
    """Render the pages of a PDF with PDFium, which is independent of the code that draws."""
    document = pypdfium2.PdfDocument(path)
    pages = [np.asarray(page.render(scale=dpi / 72, grayscale=True).to_numpy()) for page in document]
    document.close()
    return [page.reshape(page.shape[0], page.shape[1]) for page in pages]


def detected(page: Grey, dictionary: str) -> dict[int, NDArray[np.float64]]:
    """Detect the markers on a page with OpenCV: id, and corners (4, 2) in mm."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, ids, _ = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(page)
    numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
    return {
        number: np.asarray(corner, dtype=np.float64).reshape(4, 2) / PX_PER_MM
        for number, corner in zip(numbers, corners, strict=True)
    }


def sides_mm(corners_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(np.roll(corners_mm, -1, axis=0) - corners_mm, axis=1))


@pytest.mark.parametrize(
    ("page", "size_mm"), [("a4", (210, 297)), ("letter", (215.9, 279.4)), ("a3", (297, 420))]
)
def test_rig_markers_are_printed_at_their_size(
    ipsys: Ipsys, tmp_path: Path, page: str, size_mm: tuple[float, float]
) -> None:
    rig = tmp_path / "lab.toml"
    rig.write_text(
        'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.08\n'
        '[[markers]]\nid = 7\nrobot = "ada"\n[[markers]]\nid = 3\nlength_m = 0.05\n[[markers]]\nid = 99\n'
    )
    path = tmp_path / "markers.pdf"
    done = ipsys("markers", "--rig", rig, "-o", path, "--page", page)
    assert done.code == 0, done.err
    document = pypdfium2.PdfDocument(path)
    assert np.allclose(np.array(document[0].get_size()) * 25.4 / 72, size_mm, atol=0.01)
    document.close()
    seen = {n: c for sheet in rendered(path) for n, c in detected(sheet, "DICT_4X4_100").items()}
    assert sorted(seen) == [3, 7, 99]
    for number, side_mm in ((7, 80), (3, 50), (99, 80)):
        assert np.abs(sides_mm(seen[number]) - side_mm).max() < 0.1
        # The front, from corner 3 to corner 0, is up on the page, as the arrow shows.
        up = seen[number][0] - seen[number][3]
        assert abs(up[0]) < 0.1
        assert up[1] < 0


def test_several_markers_share_a_page_and_keep_margins(ipsys: Ipsys, tmp_path: Path) -> None:
    path = tmp_path / "m.pdf"
    done = ipsys("markers", "--ids", "0-10,40", "--length", "0.04", "--dictionary", "dict_5x5_50", "-o", path)
    assert done.code == 0, done.err
    pages = rendered(path)
    assert len(pages) == 1
    found = detected(pages[0], "DICT_5X5_50")
    assert sorted(found) == [*range(11), 40]
    cell_px = 40 / 7 * PX_PER_MM
    for corners_mm in found.values():
        left, top = (corners_mm.min(axis=0) * PX_PER_MM).astype(int)
        right, bottom = np.ceil(corners_mm.max(axis=0) * PX_PER_MM).astype(int)
        reach = int(cell_px) - 3
        frame = pages[0][top - reach : bottom + reach, left - reach : right + reach].copy()
        frame[reach - 3 : 3 - reach, reach - 3 : 3 - reach] = 255
        assert frame.min() == 255


def test_ruler_is_ten_centimetres_long(ipsys: Ipsys, tmp_path: Path) -> None:
    path = tmp_path / "m.pdf"
    assert ipsys("markers", "--ids", "1", "--length", "0.05", "-o", path).code == 0
    (page,) = rendered(path, 600)
    # Read a row of pixels through the ticks, 1 mm above their base line: 15 mm from the bottom.
    row = page[page.shape[0] - round(16 / 25.4 * 600)]
    dark = np.flatnonzero(np.diff((row < 128).astype(int)) == 1) / 600 * 25.4
    assert len(dark) == 101
    assert abs(dark[-1] - dark[0] - 100) < 0.1
    assert np.abs(np.diff(dark) - 1).max() < 0.1


@pytest.mark.parametrize(
    ("text", "page"), [("6x4", "a4"), ("9x6", "letter"), ("charuco:4x5", "letter"), ("charuco:5x8", "a4")]
)
def test_board_is_found_at_its_size(ipsys: Ipsys, tmp_path: Path, text: str, page: str) -> None:
    path = tmp_path / "board.pdf"
    square_m = 0.022
    done = ipsys("markers", "--board", text, "--square", square_m, "--page", page, "-o", path)
    assert done.code == 0, done.err
    (sheet,) = rendered(path)
    board = parse_board(text, square_m, 0.75, "DICT_4X4_50", False)
    seen = find_board("page", sheet, board, True)
    assert seen is not None
    assert len(seen.ids) == board.grid[0] * board.grid[1]
    flat_m = board.points_m(seen.ids)[:, :2]
    distances = [np.linalg.norm(points[:, None] - points[None], axis=-1) for points in (flat_m, seen.pixels)]
    assert np.abs(1000 * distances[0] - distances[1] / PX_PER_MM).max() < 0.15


def test_charuco_board_is_the_one_of_opencv(ipsys: Ipsys, tmp_path: Path) -> None:
    """OpenCV's detector finds all corners in the current layout, and none in the layout before 4.6."""
    path = tmp_path / "board.pdf"
    options = ("--board", "charuco:6x8", "--square", "0.025", "--marker-scale", "0.6")
    assert ipsys("markers", *options, "--dictionary", "DICT_5X5_100", "-o", path).code == 0
    (sheet,) = rendered(path)
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    counts = []
    for legacy in (False, True):
        board = cv2.aruco.CharucoBoard((6, 8), 0.025, 0.015, known)
        board.setLegacyPattern(legacy)
        _, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(sheet)
        counts.append(0 if ids is None else len(ids))
    assert counts[0] == 5 * 7
    assert counts[1] < counts[0]


def test_black_cells_have_no_seams(ipsys: Ipsys, tmp_path: Path) -> None:
    """The resolution puts the edges of cells between pixels."""
    path = tmp_path / "m.pdf"
    assert ipsys("markers", "--ids", "17", "--length", "0.0713", "-o", path).code == 0
    (page,) = rendered(path, 187)
    (corners_mm,) = detected(rendered(path)[0], "DICT_4X4_100").values()
    px_per_mm = 187 / 25.4
    left, top = corners_mm.min(axis=0) * px_per_mm
    cell_px = 71.3 / 6 * px_per_mm
    white = white_cells("DICT_4X4_100", 17)
    for row in range(6):
        for column in range(5):
            if not (white[row, column] or white[row, column + 1]):
                y = slice(round(top + row * cell_px + 4), round(top + (row + 1) * cell_px - 4))
                x = slice(round(left + column * cell_px + 4), round(left + (column + 2) * cell_px - 4))
                assert page[y, x].max() == 0


@given(st.lists(st.lists(st.booleans(), min_size=5, max_size=5), min_size=1, max_size=5))
@settings(max_examples=60)
def test_outlines_enclose_the_black_cells(rows: list[list[bool]]) -> None:
    """The shoelace formula gives the black area; the centre of each cell is inside or outside."""
    black = np.array(rows)
    outlines = cell_outlines(black)
    doubled = sum(
        float(np.sum(p[:, 0] * np.roll(p[:, 1], -1) - np.roll(p[:, 0], -1) * p[:, 1])) for p in outlines
    )
    assert doubled / 2 == black.sum()
    for row, column in np.ndindex(black.shape):
        crossed = [
            cv2.pointPolygonTest(p.astype(np.float32).reshape(-1, 1, 2), (column + 0.5, row + 0.5), False) > 0
            for p in outlines
        ]
        assert sum(crossed) % 2 == black[row, column]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "nothing to print: give --rig lab.toml"),
        (("--ids", "1"), "the side of the markers is missing"),
        (("--ids", "1", "--length", "0.2", "--page", "a4"), "holds markers of up to 142 mm: --length 0.142"),
        (("--ids", "1", "--length", "0.3"), "too much for A3, which holds markers of up to 207 mm"),
        (("--ids", "1", "--length", "20"), "cm"),
        (("--ids", "1;2", "--length", "0.1"), "is not a list of ids; write 1,2,3 or 0-9"),
        (("--ids", "100", "--length", "0.1"), "DICT_4X4_100 has the ids 0 to 99"),
        (("--ids", "1", "--length", "0.1", "--dictionary", "DICT_9X9"), "is unknown to OpenCV"),
        (
            ("--ids", "1", "--length", "0.1", "--page", "a5"),
            "--page a5: is not known; give one of a4, letter, a3",
        ),
        (("--board", "20x10"), "make its squares smaller, with --square"),
        (("--board", "6"), "write the inner corners of a chessboard as 6x4"),
        (("--ids", "1", "--length", "0.1", "-o", "m.png"), "only a PDF keeps the true size"),
    ],
)
def test_impossible_prints_are_refused(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = ipsys("markers", *arguments)
    assert done.code == 1
    assert said in done.err
    assert list(tmp_path.iterdir()) == []


def test_marker_too_large_for_a4_goes_onto_a3(ipsys: Ipsys, tmp_path: Path) -> None:
    rig, path = tmp_path / "lab.toml", tmp_path / "m.pdf"
    ipsys("init", rig)
    # The example's markers fit on both usual papers.
    for page in ("a4", "letter"):
        assert ipsys("markers", "--rig", rig, "-o", path, "--page", page, "--force").code == 0
    rig.write_text(rig.read_text().replace("marker_length_m = 0.14", "marker_length_m = 0.2"))
    done = ipsys("markers", "--rig", rig, "-o", path, "--force")
    assert "2 pages of A3, 2 markers" in done.out
    assert "A4 is too small" in done.out
    (corners_mm,) = detected(rendered(path)[0], "DICT_4X4_100").values()
    assert np.abs(sides_mm(corners_mm) - 200).max() < 0.1
    before = path.read_bytes()
    done = ipsys("markers", "--rig", rig, "-o", path)
    assert "exists already" in done.err
    assert ipsys("markers", "--rig", rig, "-o", path, "--force").code == 0
    assert path.read_bytes() == before
    ipsys("init", tmp_path / "sim.toml", "--simulated")
    done = ipsys("markers", "--rig", tmp_path / "sim.toml", "-o", path, "--force")
    assert "3 pages of A4, 3 markers" in done.out
    assert "the simulated lab needs none" in done.out
