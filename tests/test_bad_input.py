"""Bad input: one line with fault, position and next step; exit code 1; no partial file."""

import errno
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Message, Rig, RigMarker
from ipsys_log.messages.channels import MARKERS, RUN_EVENTS
from ipsys_log.units import format_time
from tests.changed_logs import rewrite
from tests.conftest import Ipsys
from tests.tiers import first_fast


def refused(ipsys: Ipsys, log: Path, *arguments: object) -> str:
    """Run a failing command; return its one line, or one line per bad row of a sheet.

    Check that no file was written.
    """
    before = {path: path.read_bytes() for path in log.parent.iterdir() if path.is_file()}
    done = ipsys(*arguments)
    assert done.code == 1
    assert done.out == ""
    assert done.err.startswith("ipsys: ")
    assert re.fullmatch(r"[^\n]+\n(  line \d+: [^\n]+\n)*", done.err)
    assert "Traceback" not in done.err
    assert {path: path.read_bytes() for path in log.parent.iterdir() if path.is_file()} == before
    return done.err


def test_not_an_mcap(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes(b"PK\3\4 something else entirely, and long enough to be read as a footer")
    assert "not an MCAP" in refused(ipsys, log, "replay", log)
    log.write_bytes(b"")
    assert "empty" in refused(ipsys, log, "info", log)
    assert "does not exist" in refused(ipsys, log, "replay", tmp_path / "b.mcap")
    assert "is not a file" in refused(ipsys, log, "info", tmp_path)


@pytest.mark.parametrize("kept", [0.5, 0.999])
def test_a_truncated_log(ipsys: Ipsys, lab: Path, kept: float) -> None:
    whole = lab.read_bytes()
    lab.write_bytes(whole[: int(len(whole) * kept)])
    line = refused(ipsys, lab, "replay", lab)
    assert "has no end" in line
    assert f"ipsys repair {lab}" in line
    assert ipsys("repair", lab).code == 0
    assert ipsys("info", lab).code == 0


def test_no_rig(ipsys: Ipsys, lab: Path) -> None:
    log = rewrite(lab, lambda message: None if isinstance(message.payload, Rig) else message)
    line = refused(ipsys, log, "replay", log)
    assert "--rig" in line
    assert "ipsys init" in line


def test_no_calibration_for_a_camera(ipsys: Ipsys, lab: Path) -> None:
    log = rewrite(lab, lambda message: None if message.topic == "/cameras/white/calibration" else message)
    line = refused(ipsys, log, "replay", log)
    assert "camera white has no calibration" in line
    assert "--calibration white=" in line
    refused(ipsys, log, "replay", log, "-o", log.with_name("out.mcap"))


@pytest.mark.parametrize("corners", ["edges", "stock"])
def test_a_calibration_of_another_size(ipsys: Ipsys, lab: Path, corners: str) -> None:
    def wider(message: Message) -> Message:
        if message.topic == "/cameras/red/calibration":
            wide = replace(message.payload, width=1920, height=1080, K=np.diag([2, 2, 1]) @ message.payload.K)
            return replace(message, payload=wide)
        return message

    log = rewrite(lab, wider)
    line = refused(ipsys, log, "replay", log, "--corners", corners)  # and adds no run
    assert "camera red: its frames are 960 x 540 px, its calibration is for 1920 x 1080" in line


def test_only_markers_that_are_not_in_the_rig(ipsys: Ipsys, lab: Path) -> None:
    def other_rig(message: Message) -> Message:
        if isinstance(message.payload, Rig):
            return replace(message, payload=replace(message.payload, markers=(RigMarker(50),)))
        return message

    log = rewrite(lab, other_rig)
    line = refused(ipsys, log, "detect", log)
    assert "ids 0, 1, 2" in line
    assert "[[markers]]" in line


def test_unknown_markers_are_excluded_and_named(ipsys: Ipsys, lab: Path) -> None:
    def smaller_rig(message: Message) -> Message:
        if isinstance(message.payload, Rig):
            kept = tuple(marker for marker in message.payload.markers if marker.id != 5)
            return replace(message, payload=replace(message.payload, markers=kept))
        return message

    log = rewrite(lab, smaller_rig)
    done = ipsys("detect", log)
    assert done.code == 0
    assert "unknown marker" in done.err
    with Session([log]) as session:
        seen = {m.id for p in session.payloads(session.topics(MARKERS, "edges")) for m in p.markers}
        events = session.payloads(session.topics(RUN_EVENTS, "edges"))
    assert seen == {0, 1, 2, 3, 4, 6, 7}
    # once for each camera, not for each frame
    assert sorted(str(event.camera) for event in events) == ["black", "red", "white"]
    assert {event.marker_id for event in events} == {5}


def doubled(lab: Path, number: int = 3) -> tuple[Path, int]:
    """Write the lab with two more copies of one marker in one frame of the red camera."""
    times: list[int] = []

    def change(message: Message) -> Message:
        if message.topic != "/cameras/red/image":
            return message
        times.append(message.log_time_ns)
        if len(times) != number:
            return message
        picture = cv2.imdecode(np.frombuffer(message.payload.data, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
        picture[200:340, 310:650] = 180
        for x in (400, 490):  # at the image centre, without distortion of lines
            marker = cv2.aruco.generateImageMarker(dictionary, 4, 42)
            picture[240:300, x : x + 60] = 255
            picture[249:291, x + 9 : x + 51] = marker[..., None]
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        return replace(message, payload=replace(message.payload, data=data))

    return rewrite(lab, change), times[number - 1]


def test_two_markers_of_one_id_in_a_frame(ipsys: Ipsys, lab: Path) -> None:
    log, time_ns = doubled(lab)
    line = refused(ipsys, log, "replay", log)
    assert "/cameras/red/image: marker 4 is seen" in line
    assert format_time(time_ns) in line
    assert "--skip-ambiguous" in line
    done = ipsys("detect", log, "--skip-ambiguous")
    assert done.code == 0
    assert "1 x ambiguous marker" in done.err


@pytest.mark.parametrize("damage", first_fast(2, ["cut", "zeros", "empty", "noise"]))
def test_a_corrupt_jpeg_in_the_middle(ipsys: Ipsys, lab: Path, damage: str) -> None:
    times: list[int] = []

    def hurt(data: bytes) -> bytes:
        middle = len(data) // 2
        return {
            "cut": data[:middle],
            "zeros": data[:middle] + bytes(2000) + data[middle + 2000 :],
            "empty": b"",
            "noise": bytes(range(256)) * 40,
        }[damage]

    def change(message: Message) -> Message:
        if message.topic != "/cameras/white/image":
            return message
        times.append(message.log_time_ns)
        # This is one of the completely decoded frames; others are decoded only in the rows with markers.
        if len(times) != 11:
            return message
        return replace(message, payload=replace(message.payload, data=hurt(message.payload.data)))

    log = rewrite(lab, change)
    done = ipsys("detect", log)
    assert done.code == 0, done.err
    assert "1 x corrupt frame, first: /cameras/white/image" in done.err
    assert f"{format_time(times[10])} ({times[10]} ns)" in done.err
    with Session([log]) as session:
        images = session.count("/cameras/white/image")
        seen = [m.log_time_ns for m in session.messages(["/runs/edges/cameras/white/markers"])]
        events = session.payloads(session.topics(RUN_EVENTS, "edges"))
    assert len(seen) == images - 1
    assert times[10] not in seen
    assert [(event.kind, event.camera) for event in events] == [("corrupt_frame", "white")]


@pytest.mark.parametrize("has_crc", [True, False])
def test_flipped_bit_in_an_image_is_named_by_its_crc(ipsys: Ipsys, lab: Path, has_crc: bool) -> None:
    with Session([lab]) as session:
        image = next(session.messages(["/cameras/white/image"])).payload.data
        topics = ["/cameras/white/image"]
        assert list(session.readers[0].changed_chunks(topics)) == []
    data = bytearray(lab.read_bytes())
    at = data.find(image) + len(image) - 200
    data[at] ^= 4
    lab.write_bytes(data)
    with Session([lab]) as session:
        ((offset, start_ns, names),) = session.readers[0].changed_chunks(topics)
    assert names == topics
    if not has_crc:
        data[offset + 33 : offset + 37] = bytes(4)  # after opcode, length, two times and a size
        lab.write_bytes(data)
    done = ipsys("detect", lab)
    assert done.code == 0, done.err
    remark = f"{lab}: the CRC of the chunk at byte {offset} is wrong: images of "
    assert done.err.count(remark) == has_crc
    assert (f"white from {format_time(start_ns)} on have changed" in done.err) == has_crc


def test_impossible_names_and_options_are_refused(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    assert "small letters" in refused(ipsys, lab, "replay", lab, "--run", "Monday/1")
    assert "camera=file.yaml" in refused(ipsys, lab, "replay", lab, "--calibration", "red")
    assert "does not have this camera" in refused(
        ipsys, lab, "replay", lab, "--calibration", f"blue={yaml(tmp_path)}"
    )
    assert "nowhere.yaml: does not exist" in refused(
        ipsys, lab, "replay", lab, "--calibration", "red=nowhere.yaml"
    )
    (tmp_path / "out.mcap").write_bytes(b"kept")
    assert "exists already" in refused(ipsys, lab, "replay", lab, "-o", tmp_path / "out.mcap")
    assert "no fitted model" in refused(ipsys, lab, "replay", lab, "--model-from", lab)


def yaml(folder: Path) -> Path:
    path = folder / "lens.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array([[500.0, 0, 480], [0, 500, 270], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.zeros((4, 1)))
    storage.write("image_width", 960)
    storage.write("image_height", 540)
    storage.write("distortion_model", "equidistant")
    storage.release()
    return path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name = ", "not valid TOML"),
        ('name = "a"\nmarker_length_m = 0,20', "write the decimal point as 0.20"),
        ("name = lab one # mine", 'text needs quotes; write "lab one"'),
        ('name = "a"', "dictionary is missing"),
        ('name = "a"\ndictionary = "DICT_4X4_100"\nmarker_length_m = "20 cm"', "must be a number"),
        ('name = "a"\ndictionary = "DICT_4X4_100"\nmarker_length_m = -1', "not a length"),
        ('name = "a"\ndictionary = "DICT_4X4_100"\nmarker_lenght_m = 1', "use marker_length_m"),
        ('name = "a"\ndictionary = "DICT_9X9"\nmarker_length_m = 0.2', "is unknown to OpenCV"),
    ],
)
def test_a_bad_rig_file(ipsys: Ipsys, lab: Path, tmp_path: Path, text: str, said: str) -> None:
    rig = tmp_path / "lab.toml"
    rig.write_text(text)
    assert said in refused(ipsys, lab, "detect", lab, "--rig", rig)


def test_a_folder_that_is_not_the_authors(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert "nowhere: does not exist" in refused(
        ipsys, lab, "import", "imsel", tmp_path / "nowhere", "-o", out
    )
    assert "has no testing.mat" in refused(ipsys, lab, "import", "imsel", tmp_path, "-o", out)
    (tmp_path / "data").mkdir()
    assert "no sub-folders with pictures" in refused(
        ipsys, lab, "import", "images", tmp_path / "data", "-o", out
    )


def test_a_bug_keeps_its_traceback(ipsys: Ipsys, lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr("ipsys_log.live_runs.pipeline.check_inputs", broken)
    with pytest.raises(KeyError, match="a bug"):
        ipsys("replay", lab)


@pytest.mark.parametrize("command", ["info", "check", "replay"])
def test_read_error_of_the_disk_is_one_line(
    ipsys: Ipsys, lab: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """The bytes from the middle of the file on cannot be read. This is no damage of the log."""
    middle, read = lab.stat().st_size // 2, os.pread

    def fail(fd: int, length: int, offset: int) -> bytes:
        if offset >= middle:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return read(fd, length, offset)

    monkeypatch.setattr(os, "pread", fail)
    done = ipsys(command, lab)
    assert done.code != 0
    assert "the disk or its connection has failed: copy the log to another disk" in " ".join(
        (done.out + done.err).split()
    )
    assert lab.name in done.out + done.err
    assert "ipsys repair" not in done.out + done.err


def test_the_real_command_too(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ipsys_log", "info", str(tmp_path / "none.mcap")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1


def test_frame_is_never_decoded_to_a_wrong_image() -> None:
    from ipsys_log.vision.decode import decode_grey

    with pytest.raises(ValueError, match="no picture"):
        decode_grey(CompressedImage(0, "a", b"GIF89a...", "gif"))
