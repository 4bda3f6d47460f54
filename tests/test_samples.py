"""The sample logs of the project, and those of earlier releases."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import POSITIONS
from tests.conftest import ROOT, Ipsys

SAMPLES = ROOT / "sample_logs"
GOLDEN = ROOT / "tests" / "golden"


@pytest.mark.parametrize("name", ["small_lab", "paper_lab"])
def test_a_sample_log_gives_centimetres(ipsys: Ipsys, tmp_path: Path, name: str) -> None:
    log = Path(shutil.copy(SAMPLES / f"{name}.mcap", tmp_path))
    model = json.loads(ipsys("replay", log, "--model", "poly", "--json").out)["models"]["poly"]
    assert set(model["cameras"]) == {"red", "white", "black"}
    for errors in model["cameras"].values():
        # The tape has a standard deviation of 3 mm; the ground truth is exact.
        assert errors["truth"]["3d"]["mean_m"] < 0.01
        assert errors["3d"]["mean_m"] < 0.015
    assert model["tracks"]["truth"]["3d"]["mean_m"] < 0.006


def test_sample_with_a_drive_is_calibrated_to_millimetres(ipsys: Ipsys, tmp_path: Path) -> None:
    log = Path(shutil.copy(SAMPLES / "drive_lab.mcap", tmp_path))
    done = ipsys("calibrate-lab", log)
    assert done.out.startswith("Enough: "), done.err
    tracks = json.loads(ipsys("replay", log, "--json").out)["models"]["joint"]["tracks"]["truth"]["2d"]
    assert tracks["mean_m"] < 0.003


def test_the_samples_are_small() -> None:
    assert sum(path.stat().st_size for path in SAMPLES.glob("*.mcap")) < 15e6
    described = (SAMPLES / "README.md").read_text()
    assert all(path.name in described for path in SAMPLES.glob("*.mcap"))


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.mcap")), ids=lambda path: path.stem)
def test_a_log_of_an_earlier_release(ipsys: Ipsys, tmp_path: Path, path: Path) -> None:
    log = Path(shutil.copy(path, tmp_path))
    with Session([log]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        messages = list(session.messages(topics))
        assert len(messages) == sum(reader.message_count for reader in session.readers)
        assert all(isinstance(encode(message.payload), bytes) for message in messages)
        assert {run.run for run in session.runs()} == {"edges", "poly", "rigid", "best"}
        before = session.payloads(session.topics(POSITIONS, "poly"))
    # The stored results are correct, and a new computation agrees to a tenth of a micrometre.
    done = ipsys("replay", log, "--model", "poly")
    renewed = {line.split()[0] for line in done.err.splitlines() if "is computed again" in line}
    assert renewed == {"camera-frame", "fit", "evaluate", "locate"}
    assert "nothing to do" in ipsys("replay", log, "--model", "poly").err
    again = tmp_path / "again.mcap"
    assert ipsys("replay", log, "--model", "poly", "--run", "again", "-o", again).code == 0
    with Session([log, again]) as session:
        after = session.payloads(session.topics(POSITIONS, "again"))
    for one, other in zip(before, after, strict=True):
        for p, q in zip(one.positions, other.positions, strict=True):
            np.testing.assert_allclose((p.x_m, p.y_m, p.z_m), (q.x_m, q.y_m, q.z_m), atol=1e-7)
