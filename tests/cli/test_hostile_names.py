"""Names in a log are untrusted: terminals, tables and pages do not obey their contents."""

import os
import pty
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.engine.output import write_log
from ipsys_log.log.codec import encode, schema_data
from ipsys_log.log.contents import Schema
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import Message, Run
from ipsys_log.plain_text import plain_text
from tests.conftest import ROOT, Ipsys

ESCAPE = "\x1b[31m\x9b2J\x07\u202ered[/bold]:smile:"
SHOWN = "\\x1b[31m\\x9b2J\\x07\\u202ered[/bold]:smile:"


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """Write a log whose file, topics, schema and run have names with escape sequences."""
    path = tmp_path / f"{ESCAPE.replace('/', '')}.mcap"
    with LogWriter.create(path) as log:
        topic = f"/runs/{ESCAPE}/record"
        log.add_channel(topic, Schema("ipsys.v1.Run", "protobuf", schema_data("ipsys.v1.Run")))
        run = Run(0, ESCAPE, ESCAPE, parameters={ESCAPE: ESCAPE}, input_runs=(ESCAPE,))
        log.write(topic, 1, 1, encode(run))
        log.add_channel(f"/{ESCAPE}", Schema(ESCAPE, ESCAPE, b""), ESCAPE)
        log.write(f"/{ESCAPE}", 2, 2, b"")
    return path


def unsafe(text: str) -> set[str]:
    return {sign for sign in text if sign != "\n" and plain_text(sign) != sign}


@pytest.mark.parametrize("command", ["info", "runs", "repair", "view", "check", "du", "cat"])
def test_commands_with_hostile_names_print_no_controls(ipsys: Ipsys, hostile: Path, command: str) -> None:
    done = ipsys(command, hostile)
    assert unsafe(done.out + done.err) == set()
    assert "\\x1b[31m" in done.out + done.err


def test_info_with_hostile_names_shows_them_as_they_are(ipsys: Ipsys, hostile: Path) -> None:
    done = ipsys("info", "--runs", hostile)
    assert done.code == 0
    assert "\\x1b[31m" in done.out
    assert "[/bold" in "".join(done.out.split())


def test_a_terminal_gets_no_escape_out_of_a_log(hostile: Path) -> None:
    """Rich uses colours on a terminal; no other escape sequences are printed."""
    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "200", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "ipsys_log", "runs", str(hostile)]
    done = subprocess.run(command, stdout=theirs, stderr=theirs, env=environment, check=False, timeout=240)
    os.close(theirs)
    shown = b""
    try:
        while part := os.read(ours, 1 << 16):
            shown += part
    except OSError:  # all messages are read
        pass
    os.close(ours)
    text = shown.decode()
    assert done.returncode == 0
    assert SHOWN.split("red", maxsplit=1)[0] in text
    assert "\x1b[31m\x9b" not in text
    assert not {"\x9b", "\x07", "\u202e"} & set(text)


def test_errors_about_hostile_names_are_one_clean_line(ipsys: Ipsys, tmp_path: Path) -> None:
    done = ipsys("info", tmp_path / "a\x1b]0;owned\x07.mcap")
    assert done.code == 1
    assert "a\\x1b]0;owned\\x07.mcap does not exist" in done.err
    assert unsafe(done.err) == set()


def test_a_name_that_is_not_utf8_is_shown(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"lab\xff.mcap")
    lab.rename(path)
    done = ipsys("info", path)
    assert done.code == 0
    assert "lab\\udcff.mcap" in done.out
    assert "lab\\udcff" in ipsys("info", tmp_path / os.fsdecode(b"lab\xff.txt")).err


@pytest.mark.slow
def test_a_report_of_hostile_names_is_written(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    def rename(message: Message) -> Message:
        payload = message.payload
        if message.topic == "/rig":
            return replace(message, payload=replace(payload, name=f"<script>{ESCAPE}"))
        return message

    path = tmp_path / os.fsdecode(b"lab\xff\x1b[31m.mcap")
    with Session([lab]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        write_log(path, map(rename, list(session.messages(topics))))
    page = tmp_path / "report.html"
    done = ipsys("report", path, "--model", "rigid", "--html", page)
    assert done.code == 0, done.err
    text = page.read_text(encoding="utf-8")
    assert "lab\\udcff\\x1b[31m.mcap" in text
    assert "<script>" not in text
    assert unsafe(text) <= {"\u00ad"}


@given(st.text(max_size=40))
def test_plain_text_keeps_letters_and_escapes_controls(text: str) -> None:
    plain = plain_text(text)
    plain.encode()  # without a lone surrogate
    assert unsafe(plain) == set()
    assert plain_text(plain) == plain
    if text.isprintable():
        assert plain == text


def test_plain_text_cuts_long_texts() -> None:
    assert len(plain_text("a" * 10_000_000)) < 3_000
