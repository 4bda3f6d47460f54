"""The page of a recording without calibration points: cameras, gaps, events and latency."""

import html
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.app.report.html import render_report
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CompressedImage, Event, Latency, Message
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys
from tests.report.browser import visit

START_NS = 1_700_000_000 * NS_PER_S
EVIL = "<script>window.ran=true</script>"
LENS = CameraCalibration(
    START_NS, "red", 640, 480, "plumb_bob", np.zeros(5), np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
)
# Frames in s from the start: at 10 Hz, with a gap of 3 s.
FRAMES_S = [*np.arange(0, 2, 0.1), *np.arange(4.9, 8, 0.1)]


def messages(with_latency: bool = True) -> list[Message]:
    """Return a recording of two cameras; ``white`` has no gap and no intrinsics."""
    found = [Message("/cameras/red/calibration", START_NS - 1, START_NS - 1, LENS, "red")]
    for camera, times_s in (("red", FRAMES_S), ("white", np.arange(0, 8, 0.2))):
        for time_s in times_s:
            time_ns = START_NS + round(time_s * NS_PER_S)
            image = CompressedImage(time_ns, camera, b"\xff\xd8", "jpeg")
            found.append(Message(f"/cameras/{camera}/image", time_ns, time_ns, image, camera))
    for second in (2, 3, 4):
        time_ns = START_NS + second * NS_PER_S
        text = f"{second} frames dropped {EVIL}"
        found.append(Message("/events", time_ns, time_ns, Event(time_ns, "frames_dropped", text, "red")))
    for number in range(100 if with_latency else 0):
        time_ns = START_NS + number * NS_PER_S // 20
        ends_ns = [time_ns + ms * 1_000_000 for ms in (5, 25, 28, 30, 31 + number)]
        latency = Latency(time_ns, "red", *ends_ns)
        found.append(Message("/latency", time_ns, time_ns, latency, "red"))
    return sorted(found, key=lambda message: message.log_time_ns)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "mon day.mcap"
    write_log(path, messages())
    return path


@pytest.fixture(scope="module")
def page(recording: Path) -> str:
    with Session([recording]) as session:
        return render_report(session, ())


def rows_of(page: str, section: str) -> list[list[str]]:
    """Return the cells of the rows in the tables of a section."""
    (text,) = re.findall(rf'<section id="{section}">(.*?)</section>', page, re.DOTALL)
    rows = re.findall(r"<tr>(.*?)</tr>", text, re.DOTALL)
    return [[html.unescape(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)] for row in rows]


def test_page_has_frames_gaps_and_events(page: str) -> None:
    recorded, gaps = rows_of(page, "recorded"), rows_of(page, "gaps")
    assert ["red", "51", "10.0", "1", "3.0", "640 x 480 px, plumb_bob"] in recorded
    assert ["white", "40", "5.0", "0", "0", "missing"] in recorded
    assert ["red", "1.9", "3.00"] in gaps
    # The last text of the kind, with escaped names.
    assert ["frames_dropped", "red", "–", "3", "2.0", "4.0", f"4 frames dropped {EVIL}"] in gaps
    assert "<script" not in page
    assert "Mean distance to the tape points" not in page


def test_page_has_the_percentiles_of_the_latency(page: str) -> None:
    total_ms = np.arange(26, 126)
    expected = [f"{value:.1f}" for value in np.percentile(total_ms, [50, 90, 99, 100])]
    assert ["total", *expected] in rows_of(page, "latency")


def test_page_without_live_positions_has_no_latency(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", messages(with_latency=False))
    with Session([tmp_path / "a.mcap"]) as session:
        page = render_report(session, ())
    assert 'id="latency"' not in page
    assert "The log has no runs" in page


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1200])
def test_recording_page_fits_a_screen(page: str, width: int, tmp_path: Path) -> None:
    seen = visit(page, width, tmp_path)
    assert (seen.console, seen.remote, seen.scripts, seen.ran) == ([], [], 0, False)
    assert seen.width <= width
    assert len(seen.images) == 3


@pytest.mark.slow
def test_report_command_writes_the_page(ipsys: Ipsys, recording: Path) -> None:
    done = ipsys("report", recording)
    assert done.code == 0, done.err
    assert "Recording: 2 cameras" in recording.with_suffix(".html").read_text()
    assert "no calibration points" in done.err


@pytest.mark.slow
def test_commands_of_the_pages_run(
    ipsys: Ipsys, recording: Path, replayed_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader copies the commands of a page into a terminal."""
    monkeypatch.chdir(tmp_path)
    for log, least in ((recording, 3), (replayed_log, 5)):
        copy = Path(shutil.copy(log, tmp_path))
        assert ipsys("report", copy.name, "--model", "rigid").code == 0
        page = copy.with_suffix(".html").read_text()
        commands = {*re.findall(r"command line: <code>(ipsys .*?)</code>", page)}
        assert len(commands) >= least
        for command in sorted(commands):
            _, *arguments = shlex.split(html.unescape(command))
            if arguments[0] == "view":  # opens a window
                arguments = [*arguments, "--save", "scene.rrd"]
            done = ipsys(*arguments)
            allowed = (0, 1) if arguments[0] == "check" else (0,)  # 1: with remarks
            assert done.code in allowed, (command, done.err)
