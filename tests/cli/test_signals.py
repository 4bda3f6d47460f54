"""Signals at any time of a command: exit codes, remaining files, and signals that stay ignored."""

import compileall
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ipsys_log.app.cli.signals import InterruptError, interruptible, writes_nothing
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.log.reader import LogReader
from tests.conftest import ROOT, SIGNALS
from tests.test_record import wait_for

SAMPLE = ROOT / "sample_logs" / "small_lab.mcap"
LIMIT_S = 240

# A program that runs the command line, and sends a signal to itself at the n-th opened file or module.
AT_EVENT = """
import os, sys
from ipsys_log.app.cli import main, signals

number, position = int(sys.argv.pop(1)), int(sys.argv.pop(1))
hold, events, ready = signals.hold_signals, 0, False

def hold_and_count():
    global ready
    hold()
    ready = not ready

def count(event, _):
    global events
    if ready and event in ("open", "import"):
        events += 1
        if events == position:
            os.kill(os.getpid(), number)

signals.hold_signals = hold_and_count
sys.addaudithook(count)
try:
    main()
finally:
    ready = False
    print(f"events {events}", file=sys.stderr)
"""


def end(position: int, number: int, *command: object) -> tuple[int, str]:
    """Run a command that gets a signal at an event; return its exit code and its standard error."""
    program = [sys.executable, "-c", AT_EVENT, str(int(number)), str(position), *map(str, command)]
    done = subprocess.run(program, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    return done.returncode, done.stderr


def count_events(*command: object) -> int:
    # A first import of a module opens more files than the next one.
    compileall.compile_dir(ROOT / "ipsys_log", quiet=1)
    code, err = end(0, signal.SIGTERM, *command)
    assert code == 0, err
    return int(err.rsplit("events ", 1)[1])


def sample_rig(folder: Path) -> Path:
    rig = folder / "lab.toml"
    rig.write_text(
        'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
        '[[reference_points]]\nname = "A"\nx_m = 0.0\ny_m = 0.0\n'
        '[[reference_points]]\nname = "B"\nx_m = 3.0\ny_m = 0.0\n'
        '[[cameras]]\nname = "red"\nsource = "sim:red"\nwidth = 320\nheight = 180\n'
    )
    return rig


@pytest.fixture
def handlers() -> Iterator[None]:
    """Restore the signal handlers after a test."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_info_interrupted_anywhere_exits_with_128_plus_signal(number: int) -> None:
    events = count_events("info", SAMPLE)
    for part in (0.02, 0.9):
        code, err = end(max(int(part * events), 1), number, "info", SAMPLE)
        assert code == 128 + number, (part, err)
        assert "Traceback" not in err
        assert err.startswith("ipsys: interrupted")


@pytest.mark.slow
def test_record_stopped_anywhere_exits_with_0(tmp_path: Path) -> None:
    rig = sample_rig(tmp_path)
    events = count_events("record", "--rig", rig, "-o", tmp_path / "all.mcap", "--seconds", "0.2")
    for index in range(12):
        part = index / 12
        log = tmp_path / f"{index}.mcap"
        number = (signal.SIGINT, signal.SIGTERM)[index % 2]
        code, err = end(max(int(part * events), 1), number, "record", "--rig", rig, "-o", log)
        assert (code, "Traceback" in err) == (0, False), (part, err)
        if log.exists():
            LogReader(log).close()  # a complete log


def start(*command: object, shell: str = "") -> subprocess.Popen[str]:
    """Start a command from a shell that first runs other shell commands."""
    program = [sys.executable, "-m", "ipsys_log", *map(str, command)]
    return subprocess.Popen(
        ["/bin/sh", "-c", f'{shell} exec "$@"', "sh", *program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_ignored_interrupt_stays_ignored_and_sigterm_stops(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    command = ("record", "--rig", sample_rig(tmp_path), "-o", log)
    with start(*command, shell="trap '' INT;") as program:
        wait_for(log, 20_000)
        program.send_signal(signal.SIGINT)
        wait_for(log, log.stat().st_size + 50_000)
        assert program.poll() is None
        program.send_signal(signal.SIGTERM)
        _, err = program.communicate(timeout=LIMIT_S)
    assert program.returncode == 0, err
    with LogReader(log) as reader:
        assert reader.message_count > 10


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_simulate_interrupted_leaves_no_partial_file(number: int, tmp_path: Path) -> None:
    size = ("--width", "320", "--height", "180", "--drive-s", "300")
    command = ("simulate", "-o", tmp_path / "lab.mcap", *size)
    with start(*command) as program:
        wait_for(tmp_path / "lab.mcap.partial", 10_000)  # the command has opened the log
        program.send_signal(number)
        _, err = program.communicate(timeout=LIMIT_S)
    assert program.returncode == 128 + number, err
    assert "Traceback" not in err
    assert os.listdir(tmp_path) == []  # noqa: PTH208


@pytest.mark.slow
def test_signal_that_timeout_sends_twice_ends_a_recording_whole(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with start("record", "--rig", sample_rig(tmp_path), "-o", log) as program:
        wait_for(log, 20_000)
        for _ in range(20):
            program.send_signal(signal.SIGTERM)
            time.sleep(0.005)
        _, err = program.communicate(timeout=LIMIT_S)
    assert program.returncode == 0, err
    LogReader(log).close()


@pytest.mark.slow
def test_closed_terminal_ends_a_recording_whole(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    child, terminal = os.forkpty()
    if child == 0:
        command = ["record", "--rig", str(sample_rig(tmp_path)), "-o", str(log)]
        os.execv(sys.executable, [sys.executable, "-m", "ipsys_log", *command])
    wait_for(log, 20_000)
    os.close(terminal)  # the kernel sends SIGHUP
    os.waitpid(child, 0)
    with LogReader(log) as reader:
        assert reader.channels["/cameras/red/image"].message_count > 0


@pytest.mark.usefixtures("handlers")
def test_interrupt_of_a_reading_command_promises_no_results() -> None:
    def command() -> None:
        signal.raise_signal(signal.SIGTERM)

    def reading() -> None:
        command()

    texts = []
    for marked in (writes_nothing(reading), command):
        with pytest.raises(InterruptError) as caught:
            interruptible(marked)()
        texts.append(caught.value.text)
    assert texts == [
        "interrupted; no file was changed",
        "interrupted; complete results are kept; nothing else is changed",
    ]


def test_partial_file_of_an_ended_process_is_removed_at_the_next_start(tmp_path: Path) -> None:
    """A signal right after the creation of a file can leave it behind."""
    with start("--version") as ended:
        ended.communicate(timeout=LIMIT_S)
    left = [tmp_path / f"a.csv.{number}.partial" for number in (ended.pid, os.getppid())]
    for file in left:
        file.touch()
    with replacement_of(tmp_path / "a.csv") as new:
        new.write(b"new")
    assert sorted(tmp_path.iterdir()) == [tmp_path / "a.csv", left[1]]
