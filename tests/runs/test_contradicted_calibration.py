"""A log whose markers contradict the intrinsics: detection, info and check say it."""

import json
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.messages import CameraCalibration, Markers, Message, calibration_topic
from ipsys_log.messages.channels import MARKERS
from ipsys_log.stages.detect import Detect
from tests.analysis.marked_floor import FISHEYE, NS, RIG, changed, sighted
from tests.conftest import Ipsys

_TEXT = "camera red: markers do not fit its calibration ("


def _messages(lens: CameraCalibration) -> list[Message]:
    frames = sighted(FISHEYE, np.random.default_rng(1))
    topic = MARKERS.topic_of("nodes", "red")
    return [
        Message("/rig", 1, 1, RIG),
        Message(calibration_topic("red"), 2, 2, lens, "red"),
        *(
            Message(topic, n * NS, n * NS, Markers(n * NS, tuple(markers), 1920, 1080), "red")
            for n, markers in enumerate(frames, 1)
        ),
    ]


@pytest.mark.parametrize(("zoom", "count"), [(1.0, 0), (1.1, 1)])
def test_markers_of_nodes_contradict_a_changed_zoom(zoom: float, count: int) -> None:
    detect = Detect()
    payloads = [p for message in _messages(changed(FISHEYE, f=zoom)) for p in detect(message)]
    events = [p for p in payloads if not isinstance(p, Markers)]
    assert [(e.kind, e.camera) for e in events] == [("calibration_contradicted", "red")] * count


def test_import_info_and_check_name_the_camera(ipsys: Ipsys, tmp_path: Path) -> None:
    lens, log = changed(FISHEYE, f=1.1), tmp_path / "log.mcap"
    (tmp_path / "red.yaml").write_text(
        f"image_width: 1920\nimage_height: 1080\ndistortion_model: equidistant\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {lens.K.ravel().tolist()}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: 4, data: {lens.D.tolist()}}}\n"
    )
    (tmp_path / "lab.toml").write_text(
        'name = "lab"\ndictionary = "DICT_4X4_50"\nmarker_length_m = 0.2\n[[cameras]]\nname = "red"\n'
    )
    head = ",".join(["time,camera,marker_id", *(f"{a}{n}_px" for n in range(4) for a in "xy")])
    rows = [
        ",".join(map(str, (1_700_000_000 + second, "red", marker.id, *marker.corners_px.ravel())))
        for second, markers in enumerate(sighted(FISHEYE, np.random.default_rng(1)))
        for marker in markers
    ]
    (tmp_path / "markers.csv").write_text("\n".join([head, *rows]))
    options = ["--rig", tmp_path / "lab.toml", "--calibration", f"red={tmp_path / 'red.yaml'}"]
    done = ipsys("import", "detections", tmp_path / "markers.csv", "-o", log, *options)
    assert done.code == 0
    assert _TEXT in " ".join(done.err.split())
    (row,) = json.loads(ipsys("info", log, "--json").out)["contradictions"]
    assert row["text"].startswith(_TEXT)
    assert _TEXT in " ".join(ipsys("info", log).out.split())
    assert "calibration_contradicted" in ipsys("check", log).out
