"""``ipsys merge`` without options: the offset of two clocks from the markers of both logs."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ipsys_log.engine.output import write_log
from ipsys_log.log.codec import decode, encode, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import shift_times
from ipsys_log.messages import Markers, Message, Rig
from ipsys_log.messages.channels import MARKERS
from tests.conftest import Ipsys
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.shared_files import make_once

CLOCKS_NS = {"red": 0, "white": 1_234_567_890, "black": -2_300_000_321}


@pytest.fixture(scope="session")
def recorders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One log for each of three cameras of a lab, each with its own clock; no images."""

    def write(folder: Path) -> None:
        settings = GeometricSettings(points=3, frame_delays_s=(0.0, 0.011, 0.022))
        settings = replace(settings, lab=replace(settings.lab, seed=3, drive_s=30.0))
        messages = list(simulate_session(build_lab(settings)))
        for camera, clock_ns in CLOCKS_NS.items():
            own = (m for m in messages if m.camera == camera or isinstance(m.payload, Rig) or _is_record(m))
            write_log(folder / f"{camera}.mcap", (_shifted(m, clock_ns) for m in own))

    folder = make_once(tmp_path_factory, "merge_recorders", write)
    return {camera: folder / f"{camera}.mcap" for camera in CLOCKS_NS}


def _is_record(message: Message) -> bool:
    return message.topic.endswith("/record")


def _shifted(message: Message, clock_ns: int) -> Message:
    name = schema_name(type(message.payload))
    return replace(
        message,
        log_time_ns=message.log_time_ns + clock_ns,
        publish_time_ns=message.publish_time_ns + clock_ns,
        payload=decode(name, shift_times(name, encode(message.payload), clock_ns)),
    )


@pytest.mark.slow
def test_offsets_of_three_recorders_are_estimated(
    ipsys: Ipsys, recorders: dict[str, Path], tmp_path: Path
) -> None:
    output = tmp_path / "all.mcap"
    done = ipsys("merge", *recorders.values(), "-o", output, "--json")
    assert done.code == 0, done.err
    logs = json.loads(done.out)["logs"]
    assert [log["offset_ns"] for log in logs[:1]] == [0]
    for log, clock_ns in zip(logs[1:], [*CLOCKS_NS.values()][1:], strict=True):
        assert log["offset_ns"] == pytest.approx(-clock_ns, abs=8_000_000)
        assert 0 < log["offset_sigma_s"] < 0.01
    with Session([output]) as session:
        assert len(session.topics(MARKERS, "geometric")) == len(CLOCKS_NS)
        (record,) = session.payloads(["/merges"])
        assert [log.offset_ns for log in record.logs] == [log["offset_ns"] for log in logs]
    # The printed lines have the offset and its sigma.
    again = ipsys("merge", *recorders.values(), "-o", output, "--overwrite")
    offset_s = logs[1]["offset_ns"] / 1e9
    assert f"{recorders['white']}: {offset_s:+.6f} s are added to its times (estimated, sigma " in again.out


def _without(path: Path, output: Path, keep: Callable[[Message], bool]) -> Path:
    with Session([path]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        write_log(output, [message for message in session.messages(topics) if keep(message)])
    return output


@pytest.mark.parametrize(
    ("keep", "text"),
    [
        (lambda m: not isinstance(m.payload, Markers) and not _is_record(m), "has no markers, so its clock"),
        (lambda m: not isinstance(m.payload, Markers) or all(one.id != 0 for one in m.payload.markers), None),
    ],
    ids=["no_markers", "other_markers"],
)
def test_log_without_common_markers_needs_an_offset(
    ipsys: Ipsys,
    recorders: dict[str, Path],
    tmp_path: Path,
    keep: Callable[[Message], bool],
    text: str | None,
) -> None:
    other, output = _without(recorders["white"], tmp_path / "other.mcap", keep), tmp_path / "all.mcap"
    done = ipsys("merge", recorders["red"], other, "-o", output)
    if text is not None:
        assert (done.code, done.out) == (1, "")
        assert text in done.err
        assert "--offset other=SECONDS" in done.err
        assert not output.exists()
    given = ipsys("merge", recorders["red"], other, "-o", output, "--overwrite", "--offset", "other=-1.5")
    assert given.code == 0, given.err
    assert "other.mcap: -1.500000 s are added to its times" in given.out
    assert output.exists()
