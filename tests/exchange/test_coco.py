"""A COCO data set has the pictures of the log, and the corners of their markers."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ipsys_log as ipsys
from ipsys_log import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedVideo, RawImage
from ipsys_log.messages.channels import IMAGES, MARKERS
from ipsys_log.vision.video import Video
from tests.conftest import ROOT, Ipsys
from tests.exchange.pictured_lab import CORNERS, RUN, START_NS, STEP_NS, PicturedLab, image


def export(log: Path, folder: Path, **options: Any) -> dict[str, Any]:
    """Return the annotation file of an exported log, with its pictures by their name."""
    with ipsys.open(log) as opened:
        opened.export(folder, format="coco", **options)
    data: dict[str, Any] = json.loads((folder / "annotations.json").read_text())
    return data


def test_pictures_and_corners_are_those_of_the_log(detected_log: Path, tmp_path: Path) -> None:
    data = export(detected_log, tmp_path / "coco")
    rows = {row["id"]: row for row in data["images"]}
    boxes: dict[int, list[dict[str, Any]]] = {number: [] for number in rows}
    for row in data["annotations"]:
        boxes[row["image_id"]].append(row)
    with Session([detected_log]) as session:
        images = {(m.camera, m.publish_time_ns): m.payload for m in session.messages(session.topics(IMAGES))}
        run = next(iter(run for run in session.run_names() if session.topics(MARKERS, run)))
        marked = list(session.messages(session.topics(MARKERS, run)))
    assert len(marked) == len(rows) > 50
    known = {(row["camera"], row["time_ns"]): row for row in rows.values()}
    for message in marked:
        row = known[str(message.camera), message.payload.timestamp]
        stored = images[message.camera, message.payload.timestamp].data
        assert (tmp_path / "coco" / row["file_name"]).read_bytes() == stored
        assert (row["width"], row["height"]) == (960, 540)
        found = boxes[row["id"]]
        assert [box["marker_id"] for box in found] == [marker.id for marker in message.payload.markers]
        for box, marker in zip(found, message.payload.markers, strict=True):
            check_annotation(box, marker.corners_px)
    assert len({row["id"] for row in data["annotations"]}) == len(data["annotations"]) > 100


def check_annotation(box: dict[str, Any], corners_px: Any) -> None:
    """Check a marker against its corners; area and outline by OpenCV."""
    points = np.reshape(box["keypoints"], (4, 3))
    assert points[:, :2].tolist() == corners_px.tolist()
    assert points[:, 2].tolist() == [2] * 4
    assert box["area"] == pytest.approx(cv2.contourArea(corners_px.astype(np.float32)), rel=1e-4)
    x, y, width, height = box["bbox"]
    low, high = corners_px.min(axis=0) + 0.5, corners_px.max(axis=0) + 0.5
    assert [x, y, x + width, y + height] == pytest.approx([*low, *high])
    assert np.reshape(box["segmentation"], (4, 2)) == pytest.approx(corners_px + 0.5)
    assert (box["category_id"], box["num_keypoints"], box["iscrowd"]) == (1, 4, 0)


def test_pictures_without_markers_are_kept_and_unsearched_left_out(tmp_path: Path) -> None:
    lab = PicturedLab({n: image(n) for n in range(4)}, {}, frozenset({0, 2, 3}), frozenset({2}))
    data = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "coco", run=RUN)
    assert [row["time_ns"] for row in data["images"]] == [START_NS + n * STEP_NS for n in (0, 2, 3)]
    assert [row["image_id"] for row in data["annotations"]] == [1, 3]
    assert np.reshape(data["annotations"][0]["keypoints"], (4, 3))[:, :2].tolist() == CORNERS.tolist()
    assert data["images"][1]["date_captured"] == "2023-11-14T22:13:20.200000000Z"
    (category,) = data["categories"]
    assert category["keypoints"] == ["top_left", "top_right", "bottom_right", "bottom_left"]


def test_corners_without_numbers_are_left_out(tmp_path: Path) -> None:
    lab = PicturedLab({0: image(0)}, {}, frozenset({0}), corners=np.full((4, 2), np.nan))
    data = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "coco", run=RUN)
    assert (len(data["images"]), data["annotations"]) == (1, [])


def test_frames_of_a_video_become_the_searched_pictures(video_log: Path, tmp_path: Path) -> None:
    with Session([video_log]) as session:
        frames = session.payloads([session.images["red"]])[:4]
    moved = {
        n: CompressedVideo(START_NS + n * STEP_NS, "red", f.data, f.format) for n, f in enumerate(frames)
    }
    lab = PicturedLab(moved, {}, frozenset({1, 3}))
    data = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "coco", run=RUN)
    video = Video("h264")
    decoded = [video(frame) for frame in moved.values()]
    for row, expected in zip(data["images"], (decoded[1], decoded[3]), strict=True):
        picture = cv2.imread(str(tmp_path / "coco" / row["file_name"]), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        assert expected is not None
        rows = np.frombuffer(expected.data, np.uint8).reshape(expected.height, expected.step)
        assert np.array_equal(picture, rows[:, : expected.width])


def test_raw_pictures_become_png(tmp_path: Path) -> None:
    grey = np.arange(320 * 180, dtype=np.uint8).reshape(180, 320)
    raw = RawImage(START_NS, "red", 320, 180, "mono8", 320, grey.tobytes())
    log = PicturedLab({0: raw}, {}, frozenset({0})).write(tmp_path / "lab.mcap")
    (row,) = export(log, tmp_path / "coco", run=RUN)["images"]
    picture = cv2.imread(str(tmp_path / "coco" / row["file_name"]), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert np.array_equal(picture, grey)


def test_markers_of_one_log_find_pictures_of_another(tmp_path: Path) -> None:
    images = PicturedLab({0: image(0)}, {}).write(tmp_path / "images.mcap")
    derived = tmp_path / "derived.mcap"
    PicturedLab({}, {}, frozenset({0})).write(derived)
    for number, logs in enumerate(((images, derived), (derived, images))):
        with ipsys.open(*logs) as opened:
            exported = opened.export(tmp_path / f"coco{number}", format="coco", run=RUN)
        assert (exported.rows, exported.content) == (1, "pictures; markers: 1")


@pytest.mark.parametrize("fault", [KeyboardInterrupt, OSError])
def test_interrupted_data_set_leaves_nothing(
    fault: type[BaseException], detected_log: Path, tmp_path: Path
) -> None:
    def stop(_: str, done: int, __: int | None) -> None:
        if done == 30:
            assert list(tmp_path.glob("*.partial/images/*/*.jpg"))
            raise fault

    with ipsys.open(detected_log) as opened, pytest.raises(fault):
        opened.export(tmp_path / "coco", format="coco", progress=stop)
    assert not list(tmp_path.iterdir())


def test_bad_requests_are_refused_in_one_line(tmp_path: Path, ipsys: Ipsys, lab: Path) -> None:
    (tmp_path / "old").mkdir()
    without = Path(shutil.copy(ROOT / "sample_logs" / "paper_lab.mcap", tmp_path / "paper.mcap"))
    other = PicturedLab({1: image(1)}, {}, frozenset({0})).write(tmp_path / "other.mcap")
    for log, name, options, text in (
        (without, "new", (), "has no images; export a log with images"),
        (lab, "new", (), "no run has markers"),
        (lab, "new", (), "compute them: ipsys replay"),
        (other, "new", ("--run", RUN), f"has no images of the markers of run {RUN}"),
        (other, "old", ("--run", RUN), "exists already; choose another name"),
        (other, "gone/new", ("--run", RUN), "gone; make it first"),
        (other, "new", ("--robot", "ada"), "a COCO data set has no robots"),
        (other, "new", ("--table", "markers"), "a COCO data set has no table markers"),
    ):
        before = sorted(tmp_path.iterdir())
        done = ipsys("export", log, "-o", tmp_path / name, "--format", "coco", *options)
        assert done.code == 1
        assert text in done.err
        assert done.err.count("\n") == 1
        assert sorted(tmp_path.iterdir()) == before


def test_unknown_format_names_the_known_ones(tmp_path: Path) -> None:
    log = PicturedLab({0: image(0)}, {}, frozenset({0})).write(tmp_path / "lab.mcap")
    with ipsys.open(log) as opened:
        with pytest.raises(IpsysError, match="use one of csv, parquet, tum, kitti, ros2, mp4, coco"):
            opened.export(tmp_path / "x", format="voc")
        with pytest.raises(IpsysError, match=r"its files end in \.mp4"):
            opened.export(tmp_path / "x.avi", format="mp4")
        with pytest.raises(IpsysError, match="or --format coco for a folder"):
            opened.export(tmp_path / "x")
