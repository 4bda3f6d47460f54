"""``ipsys calibrate`` on rendered images of a known lens, and on real images."""

import json
import re
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.calibration.images import find_sources
from ipsys_log.engine.output import write_log
from ipsys_log.exchange.calibration_files import read_intrinsics
from ipsys_log.exchange.lab_files import load_lenses
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, CompressedVideo, Message, image_topic
from ipsys_log.messages.rig_file import load_rig
from tests.calibration.boards_seen import chessboard_pattern, fisheye_rays, pixels_of, random_pose, render
from tests.capture.streams import ffmpeg
from tests.conftest import Done, Ipsys

SIZE_PX = (480, 360)
LENS = (140.0, 140.0, 243.0, 178.0, -0.02, 0.01, -0.004, 0.0005)
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
COLUMNS, ROWS, SQUARE_M = 6, 4, 0.03


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder ``red`` of twelve images of a chessboard through a fisheye."""
    folder = tmp_path_factory.mktemp("pictures") / "red"
    folder.mkdir()
    rng = np.random.default_rng(4)
    pattern = chessboard_pattern(COLUMNS, ROWS, SQUARE_M)
    ends = np.array([[x, y, 0.0] for x in (-0.105, 0.105) for y in (-0.075, 0.075)])
    count = 0
    while count < 12:
        turn, place_m = random_pose(rng, "fisheye")
        place_m = 0.75 * place_m
        outline = pixels_of("fisheye", LENS, ends @ turn.T + place_m)
        if (outline < 4).any() or (outline > np.array(SIZE_PX) - 5).any():
            continue
        picture = render(lambda at: fisheye_rays(LENS, at), turn, place_m, pattern, SIZE_PX, rng)
        cv2.imwrite(str(folder / f"{count}.png"), cv2.GaussianBlur(picture, (0, 0), 0.6))
        count += 1
    return folder


@pytest.fixture
def red(rendered: Path, tmp_path: Path) -> Path:
    """Copy the images."""
    return Path(shutil.copytree(rendered, tmp_path / "red"))


def calibrate(ipsys: Ipsys, *arguments: object) -> Done:
    return ipsys("calibrate", *arguments, "--square", SQUARE_M)


def refused(ipsys: Ipsys, folder: Path, *arguments: object) -> str:
    """Return the one line of a failing command, and check that no file was written."""
    before = sorted(folder.rglob("*"))
    done = calibrate(ipsys, *arguments)
    assert done.code == 1
    assert done.out == ""
    assert done.err.startswith("ipsys: ")
    assert done.err.count("\n") == 1
    assert sorted(folder.rglob("*")) == before
    return done.err


def test_a_folder_of_pictures(ipsys: Ipsys, red: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(red.parent)
    monkeypatch.setenv("COLUMNS", "80")
    done = calibrate(ipsys, "red", "--board", "6x4", "--plot", "red.png")
    assert done.code == 0, done.err
    lens = read_intrinsics(red.parent / "red.yaml", "red")
    assert (lens.width, lens.height, lens.distortion_model) == (*SIZE_PX, "kannala_brandt")
    storage = cv2.FileStorage(str(red.parent / "red.yaml"), cv2.FILE_STORAGE_READ)
    sigmas = [storage.getNode("standard_deviations").getNode(name).real() for name in NAMES]
    found = [lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2], *lens.D]
    assert (np.abs(np.subtract(found, LENS)) < 4 * np.array(sigmas)).all()
    assert sigmas[0] < 1.0
    # The tolerance is over distances in the image plane.
    assert float(re.findall(r"RMS (\S+) px", done.out)[0]) < 0.1
    assert max(len(line.rstrip()) for line in done.out.splitlines()) <= 80
    # The printed line for the rig is TOML, and names the file.
    line = next(line for line in done.out.splitlines() if line.startswith("calibration ="))
    assert tomllib.loads(line) == {"calibration": "red.yaml"}
    picture = cv2.imread(str(red.parent / "red.png"))
    assert picture is not None
    assert picture.shape[1] > 1000


def test_result_is_written_into_the_rig(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    rig = tmp_path / "labs" / "lab.toml"
    rig.parent.mkdir()
    ipsys("init", rig)
    assert "add --rig lab.toml" in calibrate(ipsys, red, "--board", "6x4", "--write").err
    done = calibrate(ipsys, red, "--board", "6x4", "--rig", rig, "--write", "-o", tmp_path / "lenses")
    assert done.code == 0, done.err
    assert load_rig(rig).camera("red").calibration == "../lenses/red.yaml"
    assert "put into lab.toml" not in done.out
    # The path is relative to the rig: the cameras of the lab can be opened with it.
    lenses = load_lenses(rig, [load_rig(rig).camera("red")], {})
    assert lenses["red"].K[0, 0] == pytest.approx(LENS[0], rel=0.01)


def test_all_of_it_as_json_and_in_all_formats(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    out = tmp_path / "lenses"
    formats = [word for name in ("opencv", "ros", "kalibr") for word in ("--format", name)]
    done = calibrate(ipsys, red, "--board", "6x4", "-o", out, "--json", *formats)
    assert done.code == 0, done.err
    [found] = json.loads(done.out)["rows"]
    assert found["files"] == [str(out / name) for name in ("red.yaml", "red_ros.yaml", "red_kalibr.yaml")]
    assert found["camera"] == "red"
    assert found["pictures"]["looked_at"] == 12
    assert len(found["pictures"]["used"]) == found["pictures"]["seen"]
    assert set(found["standard_deviations"]) == set(NAMES)
    assert found["coverage"]["widest_rad"] > 1.0
    for name in ("red.yaml", "red_ros.yaml"):
        lens = read_intrinsics(out / name, "red")
        assert lens.K[0, 0] == found["parameters"]["fx"]


def test_existing_files_are_overwritten_only_on_request(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("precious")
    line = refused(ipsys, tmp_path, red, "--board", "6x4", "-o", file)
    assert "exists already" in line
    assert "--force" in line
    assert file.read_text() == "precious"
    assert calibrate(ipsys, red, "--board", "6x4", "-o", file, "--force").code == 0
    assert read_intrinsics(file, "red").width == SIZE_PX[0]


@pytest.fixture
def log(rendered: Path, tmp_path: Path) -> Path:
    """Write a log in which the red camera sees the board and the white camera sees a wall."""
    wall = cv2.imencode(".png", np.full((120, 160), 90, np.uint8))[1].tobytes()

    def messages() -> Iterator[Message]:
        for n, path in enumerate(sorted(rendered.iterdir())):
            for k, (camera, data) in enumerate({"red": path.read_bytes(), "white": wall}.items()):
                time_ns = 10**18 + n * 10**8 + k
                image = CompressedImage(time_ns, camera, data, "png")
                yield Message(image_topic(camera), time_ns, time_ns, image, camera)

    path = tmp_path / "lab.mcap"
    write_log(path, messages())
    return path


def test_a_log_gives_a_file_for_each_camera_that_saw_the_board(ipsys: Ipsys, log: Path) -> None:
    done = calibrate(ipsys, log, "--board", "6x4", "-o", log.parent)
    assert done.code == 0, done.err
    assert (log.parent / "red.yaml").is_file()
    assert not (log.parent / "white.yaml").exists()
    assert "camera white: a chessboard of 6 x 4 inner corners is not found in any of the 12" in done.err
    # All other commands accept the file.
    assert (
        "does not have this camera"
        not in ipsys("detect", log, "--calibration", f"red={log.parent}/red.yaml").err
    )


def test_one_camera_of_a_log(ipsys: Ipsys, log: Path) -> None:
    line = refused(ipsys, log.parent, log, "--board", "6x4", "--camera", "white", "-o", log.parent)
    assert "camera white" in line
    line = refused(ipsys, log.parent, log, "--board", "6x4", "--camera", "blue", "-o", log.parent)
    assert "--camera blue: this camera has no frames; the cameras are red, white" in line


def test_a_video(ipsys: Ipsys, rendered: Path, tmp_path: Path) -> None:
    video = cv2.VideoWriter(str(tmp_path / "red.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SIZE_PX)
    for path in sorted(rendered.iterdir()):
        video.write(np.asarray(cv2.imread(str(path))))
    video.release()
    done = calibrate(ipsys, tmp_path / "red.avi", "--board", "6x4", "-o", tmp_path, "--json")
    assert done.code == 0, done.err
    [found] = json.loads(done.out)["rows"]
    assert found["pictures"]["looked_at"] == 12
    assert found["parameters"]["fx"] == pytest.approx(LENS[0], abs=5 * found["standard_deviations"]["fx"])


def test_too_few_pictures(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    for path in list(red.iterdir())[4:]:
        path.unlink()
    line = refused(ipsys, tmp_path, red, "--board", "6x4", "-o", tmp_path)
    assert "only 4 of 4 pictures can be used, but a calibration needs 5 or more" in line
    assert "take at least 15" in line


def test_pictures_of_two_sizes_are_refused_before_looking(
    ipsys: Ipsys, red: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No slow board search runs: the headers of the files give the size."""
    for n in range(9):
        cv2.imwrite(str(red / f"99{n}.png"), np.zeros((480, 640), np.uint8))
    monkeypatch.setattr("ipsys_log.calibration.board_search.view_board", None)
    line = refused(ipsys, tmp_path, red, "--board", "6x4", "-o", tmp_path)
    assert "pictures have 2 sizes: 12 of 480 x 360 px (0.png, 1.png ...); 9 of 640 x 480 px (990.png" in line
    assert "put the pictures of each size into a separate folder" in line


def test_a_stray_picture_of_another_size_is_left_out_and_named(
    ipsys: Ipsys, red: Path, tmp_path: Path
) -> None:
    cv2.imwrite(str(red / "99.png"), np.zeros((480, 640), np.uint8))
    done = calibrate(ipsys, red, "--board", "6x4", "-o", tmp_path)
    assert done.code == 0, done.err
    assert "99.png: is 640 x 480 px, most are 480 x 360" in done.out
    cv2.imwrite(str(red / "98.png"), np.zeros((480, 640), np.uint8))
    done = calibrate(ipsys, red, "--board", "6x4", "-o", tmp_path, "--force")
    assert "98.png, 99.png: are 640 x 480 px, most are 480 x 360" in done.out


def test_a_picture_that_cannot_be_read_is_left_out_and_named(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    (red / "13.jpg").write_bytes(b"\xff\xd8 nothing")
    done = calibrate(ipsys, red, "--board", "6x4", "-o", tmp_path)
    assert done.code == 0, done.err
    assert "13.jpg: cannot be read" in done.out


@pytest.mark.slow
def test_bad_camera_does_not_cost_the_others(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    """Return three good folders, and one with blurred images."""
    for name in ("blue", "green", "white"):
        shutil.copytree(red, tmp_path / "all" / name)
    for path in (tmp_path / "all" / "green").iterdir():
        picture = cv2.imread(str(path))
        assert picture is not None
        cv2.imwrite(str(path), cv2.GaussianBlur(picture, (0, 0), 9))
    done = calibrate(ipsys, tmp_path / "all", "--board", "6x4", "-o", tmp_path / "out", "--json")
    assert done.code == 1
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["blue.yaml", "white.yaml"]
    lines = [line for line in done.err.splitlines() if line.startswith("no file for")]
    assert len(lines) == 1
    assert lines[0].startswith("no file for green: ")
    blue, green, white = json.loads(done.out)["rows"]
    assert blue["parameters"] == white["parameters"]
    assert green["camera"] == "green"
    assert green["error"] == lines[0].removeprefix("no file for green: ")
    assert green["files"] == []


def test_better_model_is_named(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    done = calibrate(ipsys, red, "--board", "6x4", "--lens", "pinhole", "-o", tmp_path)
    assert re.search(
        r"error is 0\.\d+ px; with --lens (fisheye|pinhole8) it is 0\.0\d px: use this lens model", done.err
    )


def test_four_pictures_are_used_if_insisted_on(ipsys: Ipsys, red: Path, tmp_path: Path) -> None:
    for path in sorted(red.iterdir())[4:]:
        path.unlink()
    done = calibrate(ipsys, red, "--board", "6x4", "-o", tmp_path, "--force")
    assert done.code == 0, done.err
    assert "written only because of --force: only 4 of 4 pictures can be used" in done.err


# All photographs of a real set; rendered corners are in tests/calibration.
@pytest.mark.slow
def test_photographs_through_a_lens_of_more_than_180_degrees(
    ipsys: Ipsys, data: Path, tmp_path: Path
) -> None:
    """``cv2.fisheye.calibrate`` raises an error here. No focal length is given."""
    folder = data / "fisheye_chessboard"
    done = ipsys("calibrate", folder, "--board", "6x4", "-o", tmp_path, "--json")
    assert done.code == 0, done.err
    [found] = json.loads(done.out)["rows"]
    assert len(found["pictures"]["used"]) >= 22
    assert found["rms_px"] <= 0.30
    assert found["parameters"]["fx"] == pytest.approx(190.25, abs=4 * found["standard_deviations"]["fx"])
    assert found["coverage"]["widest_rad"] > np.pi / 2


@pytest.mark.slow
def test_video_of_a_charuco_board(ipsys: Ipsys, data: Path, tmp_path: Path) -> None:
    """Focal lengths are within 2 % of the reference, and within three of their standard deviations."""
    folder = data / "charuco_videos"
    reference = (folder / "camera_array.toml").read_text().split("[cameras.0]")[1]
    matrix = json.loads(re.findall(r"matrix = (\[\[.*?\]\])", reference)[0])
    board = ("--board", "charuco:4x5", "--dictionary", "DICT_4X4_1000", "--inverted", "--lens", "pinhole")
    done = ipsys("calibrate", folder / "cam_0.mp4", *board, "-o", tmp_path, "--json")
    assert done.code == 0, done.err
    [found] = json.loads(done.out)["rows"]
    for name, expected in (("fx", matrix[0][0]), ("fy", matrix[1][1])):
        assert found["parameters"][name] == pytest.approx(expected, rel=0.02)
        sigma = np.hypot(found["standard_deviations"][name], 0.005 * expected)
        assert abs(found["parameters"][name] - expected) < 3 * sigma
    assert len(found["pictures"]["used"]) >= 28


# Two whole calibrations.
@pytest.mark.slow
def test_a_recorded_video_gives_the_lens_of_its_pictures(
    ipsys: Ipsys, red: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """FFmpeg decodes the images; the log holds the packets, most of them no keyframes."""
    video, log, pictures = tmp_path / "red.mp4", tmp_path / "lab.mcap", tmp_path / "decoded"
    pictures.mkdir()
    codec = ("-c:v", "libx264", "-g", "5", "-crf", "12")
    make = [ffmpeg(), "-v", "error", "-framerate", "5", "-i", str(red / "%d.png"), *codec]
    subprocess.run([*make, "-bf", "0", "-pix_fmt", "yuv420p", str(video)], check=True)
    subprocess.run([ffmpeg(), "-v", "error", "-i", str(video), str(pictures / "%d.png")], check=True)
    assert ipsys("import", "videos", f"red={video}", "-o", log).code == 0
    with Session([log]) as session:
        assert {type(one) for one in session.payloads([session.images["red"]])} == {CompressedVideo}
    lenses = []
    for source in (log, pictures):
        done = calibrate(ipsys, source, "--camera", "red", "--board", "6x4", "-o", tmp_path / "x.yaml",
                         "--force", "--json")  # fmt: skip
        assert done.code == 0
        (one,) = json.loads(done.out)["rows"]
        assert one["pictures"]["seen"] == 12
        lens = read_intrinsics(tmp_path / "x.yaml", "red")
        lenses.append(lens.K)
    # The only loss between the two is the rounding of grey levels.
    assert np.abs(np.subtract(*lenses)).max() < 0.05
    # Only some frames of a long video are searched; decoding those needs the other frames.
    monkeypatch.setattr("ipsys_log.calibration.images.MAX_EXAMINED_IMAGES", 4)
    (some,) = find_sources([log], [])
    looked_at = [grey for _, grey in some.read()]
    assert len(looked_at) == 4
    for number, grey in enumerate(looked_at):
        whole = cv2.imread(str(pictures / f"{3 * number + 1}.png"), cv2.IMREAD_GRAYSCALE)
        assert whole is not None
        assert grey is not None
        assert np.abs(grey.astype(float) - whole).mean() < 1.5
