"""``ipsys align`` on rendered frames of tilted cameras."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import Camera, mount_cameras, prepare_view
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.capture.simulation.render import encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.messages import (
    RIG_TOPIC,
    CompressedImage,
    Distance,
    Floor,
    Measurement,
    Message,
    Rig,
    calibration_topic,
    image_topic,
)
from ipsys_log.vision.markers import PlacedMarker
from ipsys_log.vision.poses import look_down, pose_facing_up
from tests.changed_logs import rewrite
from tests.conftest import Ipsys, data_section
from tests.ladder import follow

Array = NDArray[np.float64]

LAB = LabSettings(width=960, height=540)
PLACES_M = ((-1.6, -0.6), (1.6, -0.6), (1.5, 0.6), (-1.6, 0.7), (0.1, 0.3), (0.6, -0.4))
TILTS = {"red": (0.0, 0.0), "white": (2.0, 60.0), "black": (5.0, 130.0)}
RIG = Rig("lab", LAB.dictionary, LAB.marker_length_m, floor=Floor(4.88, 4.88))


def hung(tilts: Mapping[str, tuple[float, float]]) -> dict[str, Camera]:
    """Return cameras above the floor, each with its tilt and the direction of the tilt axis in its image."""
    cameras = {}
    for camera in mount_cameras(LAB):
        if camera.name in tilts:
            tilt, towards = np.radians(tilts[camera.name])
            turned = look_down(camera.origin_m, tilt * np.array([np.cos(towards), np.sin(towards), 0.0]))
            cameras[camera.name] = replace(camera, camera_from_world=turned)
    return cameras


def film(
    path: Path,
    cameras: Mapping[str, Camera],
    places_m: Sequence[tuple[float, float]] = PLACES_M,
    raised_m: Mapping[int, float] | None = None,
    rig: Rig | None = RIG,
    lenses: bool = True,
) -> Path:
    """Write a log with one frame of each camera, and markers on the floor below it."""

    def messages() -> Iterator[Message]:
        if rig is not None:
            yield Message(RIG_TOPIC, EPOCH_NS, EPOCH_NS, rig)
        for n, (name, camera) in enumerate(cameras.items(), 1):
            if lenses:
                yield Message(calibration_topic(name), EPOCH_NS + n, EPOCH_NS, camera.lens, name)
        for n, (name, camera) in enumerate(cameras.items(), 100):
            x_m, y_m, _ = camera.origin_m
            prints = [
                PlacedMarker(i, 0.2, pose_facing_up(x_m + x, y_m + y, (raised_m or {}).get(i, 0.0), 0.4 * i))
                for i, (x, y) in enumerate(places_m)
            ]
            frame = render(prepare_view(camera, LAB), prints, LAB, np.random.default_rng(n))
            image = CompressedImage(EPOCH_NS, name, encode_jpeg(frame, LAB), "jpeg")
            yield Message(image_topic(name), EPOCH_NS + n, EPOCH_NS, image, name)

    path.unlink(missing_ok=True)
    write_log(path, messages())
    return path


def aligned(ipsys: Ipsys, *arguments: object) -> dict[str, Any]:
    done = ipsys("align", *arguments, "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    return {**found, "cameras": {row["camera"]: row for row in found["cameras"]}}


def test_following_the_advice_makes_a_camera_level(ipsys: Ipsys, tmp_path: Path) -> None:
    cameras = hung(TILTS)
    before = aligned(ipsys, film(tmp_path / "before.mcap", cameras))["cameras"]
    for name, (tilt_deg, _) in TILTS.items():
        assert np.degrees(before[name]["tilt_rad"]) == pytest.approx(tilt_deg, abs=0.2)
        assert before[name]["markers"] == [0, 1, 2, 3, 4, 5]
    assert [before[name]["level"] for name in TILTS] == [True, False, False]
    told = {
        name: replace(camera, camera_from_world=follow(before[name]["advice"], camera.camera_from_world))
        for name, camera in cameras.items()
    }
    after = aligned(ipsys, film(tmp_path / "after.mcap", told))["cameras"]
    for name in TILTS:
        assert after[name]["spread_m"] < 0.03
        assert np.degrees(after[name]["tilt_rad"]) < 0.2
        assert after[name]["level"] is True
        assert after[name]["spread_m"] == pytest.approx(before[name]["spread_after_m"], abs=0.015)


def test_a_marker_on_a_box_is_named(ipsys: Ipsys, tmp_path: Path) -> None:
    log = film(tmp_path / "box.mcap", hung({"white": (1.0, 200.0)}), raised_m={3: 0.06})
    found = aligned(ipsys, log)
    white = found["cameras"]["white"]
    assert white["markers"] == [0, 1, 2, 4, 5]
    assert [row["marker"] for row in white["raised"]] == [3]
    assert white["raised"][0]["above_m"] == pytest.approx(0.06, abs=0.01)
    assert np.degrees(white["tilt_rad"]) == pytest.approx(1.0, abs=0.2)
    assert any("marker 3 is 6 cm above the plane" in note for note in found["notes"])


def true_tilt(camera: Camera) -> float:
    return math.degrees(math.acos(-camera.camera_from_world[2, 2]))


def test_align_reads_a_session_with_calibration_points(
    ipsys: Ipsys, lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log has points at all heights, and then a drive: the measurements give the heights."""
    section = data_section(lab)
    found = aligned(ipsys, lab)
    settings = LabSettings(width=960, height=540, markers=8, stations=26, drive_s=1.0)
    for camera in mount_cameras(settings):
        row = found["cameras"][camera.name]
        assert np.degrees(row["tilt_rad"]) == pytest.approx(true_tilt(camera), abs=0.2)
        assert row["height_m"] == pytest.approx(camera.origin_m[2], abs=0.01)
        assert row["places"] >= 20
    overlaps = {tuple(row["cameras"]): row for row in found["overlaps"]}
    assert set(overlaps) == {("black", "white"), ("red", "white")}
    # In the simulated lab, a marker fits into the overlap of its cameras.
    assert all(row["enough"] for row in overlaps.values())
    assert found["coverage"]["unseen"] == []
    assert data_section(lab).startswith(section)
    monkeypatch.setenv("COLUMNS", "80")
    drawn = lab.with_name("map.png")
    done = ipsys("align", lab, "--plot", drawn)
    assert done.code == 0, done.err
    assert max(map(len, done.out.splitlines())) <= 80, done.out
    assert "every part of the floor is in an image" in done.out
    assert "black and white overlap by" in done.out
    picture = cv2.imread(str(drawn))
    assert picture is not None
    # the blue of the overlap of two cameras on the map
    assert (np.abs(picture.astype(int) - [232, 214, 195]).max(axis=2) < 3).mean() > 0.02


@pytest.mark.slow
def test_overlaps_need_no_tape(ipsys: Ipsys, lab: Path) -> None:
    """The plumb lines and common markers of two cameras give nearly the result of the tape."""
    by_tape = {tuple(row["cameras"]): row["width_m"] for row in aligned(ipsys, lab)["overlaps"]}

    def heights_only(message: Message) -> Message:
        if isinstance(message.payload, Measurement):
            return replace(message, payload=replace(message.payload, distances=()))
        return message

    found = aligned(ipsys, rewrite(lab, heights_only))
    assert found["coverage"] is None
    for row in found["overlaps"]:
        assert row["width_m"] == pytest.approx(by_tape[tuple(row["cameras"])], abs=0.04)
        assert row["at_m"] is None
    assert len(found["overlaps"]) == 2


@pytest.mark.slow
def test_gross_tape_error_does_not_change_the_alignment(ipsys: Ipsys, lab: Path) -> None:
    def too_short(message: Message) -> Message:
        if isinstance(message.payload, Measurement) and message.payload.id == "s000":
            distances = (Distance("A", 0.4), Distance("B", 0.5))
            return replace(message, payload=replace(message.payload, distances=distances))
        return message

    found = aligned(ipsys, rewrite(lab, too_short))
    assert found["coverage"] is None
    assert "the calibration points were not used: measurement s000" in " ".join(found["notes"])
    assert len(found["cameras"]) == 3


@pytest.mark.slow
def test_camera_moved_after_the_measurement_gives_a_note(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    tilted = hung({"white": (4.0, 270.0)})
    assert ipsys("fit", lab, "--model", "poly").code == 0
    log = film(tmp_path / "moved.mcap", tilted)
    assert ipsys("fit", log, "--model", "poly", "--model-from", lab).code == 0
    found = aligned(ipsys, log)
    assert "camera white has moved since its calibration points" in " ".join(found["notes"])
    assert found["coverage"] is not None


def test_too_few_markers_are_reported(ipsys: Ipsys, tmp_path: Path) -> None:
    cameras = hung({"red": (3.0, 0.0)})
    done = ipsys("align", film(tmp_path / "a.mcap", cameras, places_m=()))
    assert (done.code, done.out) == (1, "")
    assert "no marker was found in 1 frames" in done.err
    one = aligned(ipsys, film(tmp_path / "a.mcap", cameras, places_m=PLACES_M[:1]))
    red = one["cameras"]["red"]
    assert (red["spread_m"], red["tilt_rad"], red["level"]) == (None, None, None)
    assert "one is not enough" in red["advice"]
    assert any("at least three calibration points" in note for note in one["notes"])
    near = aligned(ipsys, film(tmp_path / "a.mcap", hung({"red": (0.0, 0.0)}), ((0, 0), (0.5, 0), (0, 0.4))))
    assert any("span only" in note for note in near["notes"])


def test_missing_data_of_a_log_give_notes(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    cameras = hung({"red": (3.0, 0.0)})
    done = ipsys("align", film(tmp_path / "a.mcap", cameras, rig=None))
    assert (done.code, done.out) == (1, "")
    assert "has no rig" in done.err
    done = ipsys("align", film(tmp_path / "a.mcap", cameras, lenses=False))
    assert (done.code, done.out) == (1, "")
    assert "camera red has no calibration" in done.err
    done = ipsys("align", tmp_path / "a.mcap", "--plot", tmp_path / "nowhere" / "map.png")
    assert (done.code, done.out) == (1, "")
    assert "there is no folder" in done.err

    def no_floor(message: Message) -> Message:
        payload = message.payload
        return replace(message, payload=replace(payload, floor=None)) if isinstance(payload, Rig) else message

    found = aligned(ipsys, rewrite(lab, no_floor))
    assert found["coverage"] is None
    assert any("coverage needs the size of the floor: write [floor]" in note for note in found["notes"])


def test_camera_points_without_markers_are_by_eq_3(ipsys: Ipsys, data: Path, tmp_path: Path) -> None:
    log = tmp_path / "imsel.mcap"
    assert ipsys("import", "imsel", data / "imsel", "-o", log).code == 0
    found = aligned(ipsys, log)
    assert set(found["cameras"]) == {"red", "white", "black"}
    assert any("eq. (3)" in note for note in found["notes"])
