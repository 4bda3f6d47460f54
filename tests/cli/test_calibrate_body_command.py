"""``ipsys calibrate-body`` on the command line."""

import json
from pathlib import Path

import pytest

import ipsys_log as ipsys_api
from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import ChannelWritten, Message, Run
from ipsys_log.messages.channels import CALIBRATED_RIG, MARKERS, MODEL
from ipsys_log.messages.rig_file import load_rig, rig_toml
from tests.conftest import Ipsys
from tests.joint.small_lab import make_lab
from tests.joint.test_body_calibration import RIG, TRUE, carry


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a log with the model joint, and a log of carrying a body."""
    folder, fit = tmp_path_factory.mktemp("body"), fit_jointly(make_lab(4, points=20)[0])
    model, runs = joint_payload(fit, {}, 0), []
    for name, stage, topic in (("joint", "fit", MODEL), ("edges", "detect", MARKERS)):
        topics = [topic.topic_of(name, camera) for camera in ("c0", "c1")[: 1 + (topic is MARKERS)]]
        outputs = tuple(ChannelWritten(one, 1) for one in topics)
        run = Run(0, name, stage, {"model": "joint"} if topic is MODEL else {}, outputs=outputs)
        runs.append(Message(f"/runs/{name}/record", 0, 0, run))
    rig = Message("/rig", 0, 0, RIG)
    write_log(folder / "lab.mcap", [rig, Message(MODEL.topic_of("joint"), 0, 0, model), runs[0]])
    frames = [
        Message(
            MARKERS.topic_of("edges", m.camera), m.log_time_ns + 1, m.publish_time_ns, m.payload, m.camera
        )
        for m in carry(build_models(fit))
    ]
    write_log(folder / "carry.mcap", [rig, runs[1], *frames])
    return folder / "lab.mcap", folder / "carry.mcap"


def test_carried_body_is_written_into_log_and_rig(
    ipsys: Ipsys, carried: tuple[Path, Path], tmp_path: Path
) -> None:
    toml = tmp_path / "lab.toml"
    toml.write_text("# our lab\n" + rig_toml(RIG))
    words = (*carried, "--robot", "drone", "--write", toml, "-o", tmp_path / "new.mcap")
    done = ipsys("calibrate-body", *words)
    assert done.code == 0, done.err
    assert max(map(len, done.out.splitlines())) <= 80
    assert "Size of the body: ± 0." in done.out
    assert "two cameras" not in done.out
    rig = load_rig(toml)
    assert toml.read_text().startswith("# our lab\n")
    assert rig.markers[3].xyz_m == pytest.approx(TRUE.markers[3].xyz_m, abs=1e-3)
    assert rig.bodies[0].scale_sigma is not None
    with Session([tmp_path / "new.mcap"]) as session:
        assert session.payloads([CALIBRATED_RIG.topic_of("drone_body")]) == [rig]
    options = ("--rig", toml, "--end", "30", "--json", "-o", tmp_path / "part.mcap")
    part = json.loads(ipsys("calibrate-body", *carried, *options).out)
    assert len(part["markers"]) == 4
    assert 0 < part["frames"] < 60
    with ipsys_api.open(*carried) as log:
        assert [marker.id for marker in log.calibrate_body("drone", toml).markers] == [0, 1, 2, 3]
    few = ipsys("calibrate-body", *carried, "--end", "10", "-o", tmp_path / "few.mcap")
    assert "Carry it where two cameras see it" in " ".join(few.out.split())


def test_bad_input_of_calibrate_body_is_one_line(
    ipsys: Ipsys, carried: tuple[Path, Path], tmp_path: Path
) -> None:
    lab, carry_log = carried
    for words, text in (
        ((carry_log,), "has no model joint"),
        ((lab,), "has no markers"),
        ((*carried, "--robot", "ada"), "ada: is no body of the rig, which has drone"),
        ((*carried, "--start", "1000"), "has no message in the range"),
    ):
        done = ipsys("calibrate-body", *words, "-o", tmp_path / "new.mcap")
        assert (done.code, done.err.count("\n"), done.out) == (1, 1, ""), done.err
        assert text in done.err
        assert not (tmp_path / "new.mcap").exists()
