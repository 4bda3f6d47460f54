"""``ipsys node``: frames in both logs, and clear errors."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from ipsys_log.capture import camera_thread
from ipsys_log.capture.nodes import centre
from ipsys_log.log.codec import decode, encode, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Rig, RigNodes
from ipsys_log.messages.rig_file import load_rig, rig_toml
from tests.capture.nodes.lab_of_nodes import make_certificates
from tests.conftest import Ipsys
from tests.ports import free_port

PATIENCE_S = 600
RIG = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2

[nodes]
centre = "127.0.0.1:{port}"
{more}
[[cameras]]
name = "red"
source = "{source}"
width = 480
height = 270
rate_hz = 10
"""


def write_rigs(folder: Path, source: str, more: str = "") -> int:
    """Write the rig of the node and that of the centre; return the port of the centre."""
    port = free_port()
    for name, one in (("node", source), ("centre", "zenoh:red")):
        (folder / f"{name}.toml").write_text(RIG.format(port=port, more=more, source=one))
    return port


@contextmanager
def node_of(folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Start a node that records; it is killed if the test fails."""
    arguments = ["node", "node.toml", "--camera", "red", "-o", "red.mcap", *options]
    command = [sys.executable, "-m", "ipsys_log", *arguments]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as node:
        try:
            yield node
        finally:
            node.kill()


def frames(log: Path) -> dict[int, tuple[str, bytes]]:
    with Session([log]) as session:
        messages = session.messages([session.images["red"]])
        return {m.publish_time_ns: (m.payload.format, m.payload.data) for m in messages}


@pytest.fixture(autouse=True)
def _patient_centre(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the centre wait for its node as long as the test does."""
    monkeypatch.setattr(centre, "_FIRST_ANSWER_S", PATIENCE_S)
    monkeypatch.setattr(camera_thread, "_DRAW_S", PATIENCE_S)


@pytest.mark.slow
@pytest.mark.parametrize("with_certificates", [False, True])
def test_both_logs_have_the_same_frames(tmp_path: Path, with_certificates: bool, ipsys: Ipsys) -> None:
    more = ""
    if with_certificates:
        make_certificates(tmp_path / "lab", "127.0.0.1", "red")
        more = 'certificates = "lab/certificates"\n'
    write_rigs(tmp_path, "sim:red?stations=0", more)
    with node_of(tmp_path) as node:
        rig = ("--rig", tmp_path / "centre.toml")
        recorded = ipsys("record", *rig, "-o", tmp_path / "centre.mcap", "--seconds", 3)
        node.terminate()
        said, _ = node.communicate(timeout=PATIENCE_S)
    assert (recorded.code, node.returncode) == (0, 0), recorded.err + said
    assert "receives the frames of camera red" in said
    at_node, at_centre = frames(tmp_path / "red.mcap"), frames(tmp_path / "centre.mcap")
    assert at_centre
    assert set(at_centre.values()) <= set(at_node.values())
    with Session([tmp_path / "centre.mcap"]) as session:
        assert session.payloads(["/cameras/red/clock"])[0].camera == "red"


@pytest.mark.slow
@pytest.mark.parametrize("detects", [False, True])
def test_node_without_a_centre_says_what_was_not_sent(
    tmp_path: Path, lab_log: Path, detects: bool, ipsys: Ipsys
) -> None:
    port, log = write_rigs(tmp_path, "sim:red?stations=0"), tmp_path / "red.mcap"
    options = ("--detect", "--calibration", lab_log) if detects else ()
    done = ipsys("node", tmp_path / "node.toml", "--camera", "red", "-o", log, "--seconds", 1, *options)
    assert done.code == 0, done.err
    missing = rf"{'the markers of ' if detects else ''}\d+ frames of camera red"
    line = rf"the centre 127\.0\.0\.1:{port} does not have {missing}; {log} has all"
    assert re.search(line, " ".join(done.err.split()))


def markers_at_node(log: Path, run: str) -> list[bytes]:
    """Return the markers of a run by the number of their frame, without their times."""
    with Session([log]) as session:
        payloads = session.payloads([f"/runs/{run}/cameras/red/markers"])
        return [encode(replace(markers, timestamp=0)) for markers in payloads]


def test_rig_file_keeps_the_network_of_nodes(tmp_path: Path) -> None:
    rig = Rig("lab", "DICT_4X4_100", 0.2, nodes=RigNodes("192.168.1.10:7449", "certificates"))
    (tmp_path / "lab.toml").write_text(rig_toml(rig))
    assert load_rig(tmp_path / "lab.toml") == rig
    assert decode(schema_name(Rig), encode(rig)) == rig


def test_wrong_node_is_refused_with_one_line(tmp_path: Path, ipsys: Ipsys) -> None:
    write_rigs(tmp_path, "sim:red?stations=0", 'certificates = "keys"\n')

    def refusal(*arguments: str) -> str:
        done = ipsys("node", *arguments)
        assert done.code == 1
        assert "Traceback" not in done.err
        return done.err

    node = str(tmp_path / "node.toml")
    assert "name the camera of this host: ipsys node" in refusal(node)
    assert "red.key: does not exist" not in refusal(node, "--camera", "red")
    assert "authority.pem: does not exist; docs/nodes.md" in refusal(node, "--camera", "red")
    assert "zenoh:red, which belongs to the centre" in refusal(
        str(tmp_path / "centre.toml"), "--camera", "red"
    )
    assert "none.toml: does not exist; to write a rig file: ipsys init" in refusal(
        "none.toml", "--camera", "red"
    )
    assert "--centre far: is not an address" in refusal(node, "--camera", "red", "--centre", "far")
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.slow
def test_live_from_markers_of_nodes_is_verified(
    tmp_path: Path, lab_log: Path, calibration: Path, ipsys: Ipsys
) -> None:
    """The markers at the centre are those of the node, for each key byte for byte; frames stay at the node.

    The key is the session of the node and the number of the frame. The detection from the recorded images of
    the node is repeated, and gives the same bytes.
    """
    write_rigs(tmp_path, "sim:red?stations=5")
    with node_of(tmp_path, "--detect", "--calibration", str(lab_log)) as node:
        lenses = ("--rig", tmp_path / "centre.toml", "--calibration", lab_log)
        model = ("--model-from", calibration, "--seconds", 3)
        live = ipsys("live", *lenses, *model, "-o", tmp_path / "centre.mcap")
        assert live.code == 0, live.err
        node.terminate()
        said, _ = node.communicate(timeout=PATIENCE_S)
    assert node.returncode == 0, said
    again = ipsys("detect", tmp_path / "red.mcap", "--as-live", "--run", "again")
    assert again.code == 0, again.err
    made, repeated = (markers_at_node(tmp_path / "red.mcap", run) for run in ("edges", "again"))
    assert repeated == made
    with Session([tmp_path / "centre.mcap"]) as session:
        assert session.images == {}
        arrived = session.payloads(["/runs/nodes/cameras/red/markers"])
        assert session.payloads(["/runs/poly/tracks"])
        sessions = {estimate.session for estimate in session.payloads(["/cameras/red/clock"])}
    assert arrived
    assert {markers.node_session for markers in arrived} == sessions
    numbers = [markers.node_frame for markers in arrived]
    assert len(set(numbers)) == len(numbers)
    for number, markers in zip(numbers, arrived, strict=True):
        assert encode(replace(markers, timestamp=0, node_session=None, node_frame=None)) == made[number]
    verified = ipsys("verify", tmp_path / "centre.mcap")
    assert verified.code == 0, verified.out
    assert "the replay is identical to the log" in verified.out
    replayed = ipsys("replay", tmp_path / "centre.mcap", "--model-from", calibration)
    assert replayed.code == 0, replayed.err
    assert ipsys("verify", tmp_path / "red.mcap").code == 0
