"""The input files of cases: shipped files, results of the old commit, and files derived from these.

Both commits get the same files, so a case differs only where its own commands do.
"""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from tests.same_bytes.cases import Case, ipsys
from tests.same_bytes.differences import Log, decode, read_log

_LAB = "--width 960 --height 540 --markers 8 --stations 20 --frames-per-station 2 --rate-hz 5 --drive-s 1"
_START = "--rig live.toml --calibration lab.mcap"
# The inputs and the command for each file that the old commit makes.
MADE: dict[str, Case] = {
    "lab.mcap": Case("lab", (), (ipsys(f"simulate -o lab.mcap {_LAB}"),)),
    "fitted.mcap": Case("fitted", ("lab.mcap",), (ipsys("locate lab.mcap {models} -o fitted.mcap"),)),
    "lab.toml": Case("rig", ("lab.mcap",), (ipsys("init lab.toml --from lab.mcap"),)),
    "0_measure.json": Case(
        "places", ("unmeasured.mcap",), (ipsys("measure unmeasured.mcap --places --json"),)
    ),
    "live.mcap": Case(
        "live-log",
        ("lab.mcap", "live.toml", "fitted.mcap"),
        (ipsys(f"live {_START} --model-from fitted.mcap --model poly -o live.mcap", scripted=True),),
    ),
}


class MissingInputError(Exception):
    """A missing input, such as public data."""


class UnmadeInputError(Exception):
    """An input that the old commit cannot make."""


class Inputs:
    """A maker of inputs in a folder, each at its first request.

    Parameters
    ----------
    tree : the work tree of the old commit.
    run : runs a case with the old commit; returns the folder that it ran in.
    """

    def __init__(self, folder: Path, tree: Path, run: Callable[[Case], Path]) -> None:
        self.folder, self._tree, self._run = folder, tree, run

    def make(self, names: Sequence[str]) -> None:
        """Make inputs, and the inputs that these need.

        Raises
        ------
        MissingInputError
            An input is missing.
        UnmadeInputError
            The old commit cannot make an input.
        """
        for name in names:
            if not (self.folder / name).exists():
                self._make(name)

    def _make(self, name: str) -> None:
        shipped = (self._tree / "sample_logs" / name, self._tree / "tests" / "golden" / name)
        for path in shipped:
            if path.is_file():
                shutil.copy(path, self.folder / name)
                return
        if name in MADE:
            case = MADE[name]
            command = " ".join(case.steps[0].arguments)
            self.make(case.inputs)
            made = self._run(case) / name
            if not made.is_file():
                raise UnmadeInputError(f"{name}: the old commit does not make it: ipsys {command}")
            shutil.copy(made, self.folder / name)
        elif name in _DERIVED:
            sources, derive = _DERIVED[name]
            self.make(sources)
            derive(self.folder, self.folder / name)
        else:
            raise MissingInputError(f"{name}: is not in the work tree of the old commit")


def _live_rig(folder: Path, target: Path) -> None:
    """Write the rig of the lab, with cameras that play its log."""
    text = (folder / "lab.toml").read_text()
    cameras = r'(\[\[cameras\]\]\nname = "(\w+)"\n)'
    target.write_text(re.sub(cameras, r'\1source = "file:lab.mcap?\2"\n', text))


def _cut(source: str, share: float) -> Callable[[Path, Path], None]:
    def derive(folder: Path, target: Path) -> None:
        whole = (folder / source).read_bytes()
        target.write_bytes(whole[: round(share * len(whole))])

    return derive


def _without_end(folder: Path, target: Path) -> None:
    target.write_bytes((folder / "v0_1_0.mcap").read_bytes()[:-300])


def _flipped(folder: Path, target: Path) -> None:
    data = bytearray((folder / "v0_1_0.mcap").read_bytes())
    data[len(data) // 2] ^= 0x55
    target.write_bytes(data)


def _frames(log: Log, camera: str) -> Iterator[bytes]:
    topic = f"/cameras/{camera}/image"
    for entry in log.entries:
        if entry.topic == topic:
            message: Any = decode(entry.data, log.schemas[topic])
            yield message.data


def _pictures(folder: Path, target: Path) -> None:
    log = read_log(folder / "lab.mcap")
    for camera in ("red", "white", "black"):
        (target / camera).mkdir(parents=True)
        for number, data in enumerate([*_frames(log, camera)][:4]):
            (target / camera / f"{number}.jpg").write_bytes(data)


def _video(folder: Path, target: Path) -> None:
    """Encode the frames of a camera as H.264, with a keyframe every five frames."""
    with av.open(str(target), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 960, 540, "yuv420p"
        stream.gop_size, stream.max_b_frames = 5, 0
        for data in _frames(read_log(folder / "lab.mcap"), "red"):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            frame = av.VideoFrame.from_ndarray(np.asarray(image, np.uint8), format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _board(folder: Path, target: Path) -> None:
    """Render images of a chessboard with 6 x 4 inner corners in a camera without distortion."""
    (target / "red").mkdir(parents=True)
    cell_px, rng = 60, np.random.default_rng(0)
    squares = np.indices((5, 7)).sum(axis=0) % 2
    flat = np.full((7 * cell_px, 9 * cell_px), 230, np.uint8)
    board = np.kron(squares, np.ones((cell_px, cell_px)))
    flat[cell_px:-cell_px, cell_px:-cell_px] = np.where(board, 230, 30)
    K = np.array([[600.0, 0, 480], [0, 600, 270], [0, 0, 1]])
    corners_m = np.array([[-4.5, -3.5, 0], [4.5, -3.5, 0], [4.5, 3.5, 0], [-4.5, 3.5, 0]]) * 0.03
    corners_px = np.array([[0, 0], [9, 0], [9, 7], [0, 7]], np.float32) * cell_px
    for number in range(12):
        turn, place_m = rng.uniform(-0.5, 0.5, 3), rng.uniform((-0.08, -0.03, 0.28), (0.08, 0.03, 0.4))
        seen_px, _ = cv2.projectPoints(corners_m, turn, place_m, K, np.zeros(4))
        H = cv2.getPerspectiveTransform(corners_px, seen_px.reshape(4, 2).astype(np.float32))
        image = cv2.warpPerspective(flat, H, (960, 540), borderValue=(120,))
        cv2.imwrite(str(target / "red" / f"{number:02}.png"), cv2.GaussianBlur(image, (0, 0), 0.8))


def _unmeasured(folder: Path, target: Path) -> None:
    """Write the lab without its measurements."""
    with (folder / "lab.mcap").open("rb") as source, target.open("wb") as out:
        writer = Writer(out)
        writer.start()
        ids: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic == "/measurements" or schema is None:
                continue
            if channel.topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            writer.add_message(
                ids[channel.topic], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()  # type: ignore[no-untyped-call]


def _sheet(folder: Path, target: Path) -> None:
    """Write the distances of the lab's measurements as a sheet, for points with a stationary marker."""
    log = read_log(folder / "lab.mcap")
    start_ns = min(entry.log_time_ns for entry in log.entries)
    found = json.loads((folder / "0_measure.json").read_text())
    places = found if isinstance(found, list) else found["rows"]  # a list before format 2
    rows = ["marker,d_A_cm,d_B_cm,side,height_cm,place,id"]
    for entry in log.entries:
        if entry.topic != "/measurements":
            continue
        one: Any = decode(entry.data, log.schemas[entry.topic])
        time_s = (entry.publish_time_ns - start_ns) / 1e9
        place = [p for p in places if p["marker"] == one.marker_id and abs(p["time_s"] - time_s) < 0.5]
        if place:
            lengths_cm = {distance.reference: 100 * distance.distance_m for distance in one.distances}
            numbers = (f"{value:.1f}" for value in (lengths_cm["A"], lengths_cm["B"]))
            cells = (
                one.marker_id,
                *numbers,
                one.side,
                f"{100 * one.height_m:.1f}",
                place[0]["place"],
                one.id,
            )
            rows.append(",".join(map(str, cells)))
    target.write_text("\n".join(rows) + "\n")


def _imsel(folder: Path, target: Path) -> None:
    """Return the authors' data in the folder IPSYS_DATA, as in the tests."""
    root = Path(__file__).resolve().parent.parent.parent
    data = Path(os.environ.get("IPSYS_DATA", root / "../shared/data")).resolve() / "imsel"
    if not data.is_dir():
        raise MissingInputError("imsel: no public data; docs/data.md says where to get it")
    shutil.copytree(data, target)


# For each input name, its source and the function that derives it.
_DERIVED: dict[str, tuple[tuple[str, ...], Callable[[Path, Path], None]]] = {
    "live.toml": (("lab.toml",), _live_rig),
    "pictures": (("lab.mcap",), _pictures),
    "red.mp4": (("lab.mcap",), _video),
    "board": ((), _board),
    "unmeasured.mcap": (("lab.mcap",), _unmeasured),
    "sheet.csv": (("lab.mcap", "0_measure.json"), _sheet),
    "imsel": ((), _imsel),
    "no-end.mcap": (("v0_1_0.mcap",), _without_end),
    "cut.mcap": (("v0_1_0.mcap",), _cut("v0_1_0.mcap", 0.6)),
    "flipped.mcap": (("v0_1_0.mcap",), _flipped),
    "cut-live.mcap": (("live.mcap",), _cut("live.mcap", 0.7)),
}
