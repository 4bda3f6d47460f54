"""Each command with a URL: it reads the log there, or refuses the URL in one line and writes nothing."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.log import remote_object
from tests.cli.test_commands import COMMANDS
from tests.cli.test_output_names import RIG
from tests.conftest import ROOT, Ipsys
from tests.s3_server import put
from tests.test_record import lens_yaml

PAPER_LAB = ROOT / "sample_logs" / "paper_lab.mcap"
# No server listens there.
HTTPS, S3 = "https://ada:secret@127.0.0.1:1/lab/x.mcap", "s3://lab/x.mcap"
SHOWN = {HTTPS: "https://ada:***@127.0.0.1:1/lab/x.mcap", S3: S3}

# In a command line, U is a URL, LOG a log and RIG a rig file.
WRITE_INTO_A_LOG = (
    "exclude U p001 --reason x",
    "import detections LOG --into U",
    "import truth LOG --into U",
    "measure U --places",
    "measure U --csv sheet.csv",
    "repair U",
)
READ_FILES = (
    "calibrate U --board 6x4",
    "import videos red=U -o new.mcap",
    "pack U -o dataset --card card.toml",
)
NEED_LOCAL_PATHS = (
    "align LOG --rig U",
    "cameras --rig U",
    "import images U -o new.mcap",
    "import imsel U -o new.mcap",
    "import pairs U --rig RIG -o new.mcap",
    "import ros U -o new.mcap",
    "init U",
    "markers --rig U",
    "node U --camera red",
    "plan LOG --plot U",
    "report LOG --html U",
    "setup U",
    "stream LOG --udp 127.0.0.1:9 --key U",
    "view LOG --save U",
)
WRITE_NEW_FILES = (
    "align LOG -o U",
    "batch export LOG -o U",
    "batch replay LOG -o U",
    "calibrate-body LOG -o U",
    "calibrate-lab LOG -o U",
    "catalogue . -o U",
    "compare LOG -o U",
    "cut LOG -o U",
    "drive --model-from LOG -o U",
    "export LOG -o U",
    "live --model-from LOG --rig RIG -o U",
    "merge LOG LOG -o U",
    "record --rig RIG -o U",
    "replay LOG -o U",
    "simulate -o U",
)
READ_LOGS = (
    "align U",
    "calibrate-body U",
    "calibrate-lab U",
    "cat U",
    "compare U",
    "cut --compact U -o new.mcap",
    "cut U -o new.mcap",
    "replay --until detect LOG --calibration U",
    "replay --until detect LOG --calibration red=U",
    "verify --compare U LOG",
    "verify --compare LOG U",
    "drift LOG U",
    "drift LOG --baseline U",
    "drive --model-from U -o new.mcap",
    "info --sizes U",
    "evaluate U",
    "export U -o new.csv",
    "info U",
    "init new.toml --from U",
    "info --latency U",
    "live --model-from U --rig RIG -o new.mcap",
    "replay LOG --model-from U -o new.mcap",
    "record --measure --rig RIG --terminal --model-from U -o new.mcap",
    "merge LOG U -o new.mcap",
    "plan U",
    "record --measure --rig RIG --model-from U -o new.mcap",
    "replay U",
    "report U",
    "info --runs U",
    "stream U --udp 127.0.0.1:9",
    "verify U",
    "view U --save new.rrd",
)
# They print a result for each log, and an error in it.
REPORT_ERRORS = ("batch check", "batch evaluate", "batch verify", "check")
# It takes the address of a dataset.
OTHER = ("score",)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Change to a folder with a log and a rig; no request is repeated after a pause."""
    shutil.copy(PAPER_LAB, tmp_path / "log.mcap")
    (tmp_path / "lab.toml").write_text(RIG)
    (tmp_path / "red.yaml").write_text(lens_yaml(640, 480))
    monkeypatch.setattr(remote_object, "_PAUSES_S", (0.0,))
    monkeypatch.chdir(tmp_path)
    before = contents(tmp_path)
    yield tmp_path
    assert contents(tmp_path) == before, "the command has written"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run(ipsys: Ipsys, line: str, url: str) -> str:
    """Run a command that must fail; return its one line."""
    known = {"LOG": "log.mcap", "RIG": "lab.toml", "U": url, "red=U": f"red={url}"}
    done = ipsys(*(known.get(word, word) for word in line.split()))
    assert done.code == 1, (done.out, done.err)
    assert "secret" not in done.err
    (text,) = [text for text in done.err.splitlines() if text.startswith("ipsys: ")]
    return text.removeprefix("ipsys: ")


@pytest.mark.parametrize(
    ("line", "url"),
    [
        *((line, HTTPS) for line in (*WRITE_INTO_A_LOG, *READ_FILES, *NEED_LOCAL_PATHS, *WRITE_NEW_FILES)),
        *((lines[0], S3) for lines in (WRITE_INTO_A_LOG, READ_FILES, NEED_LOCAL_PATHS, WRITE_NEW_FILES)),
    ],
)
def test_command_that_needs_a_file_refuses_a_url(line: str, url: str, here: Path, ipsys: Ipsys) -> None:
    expected = {
        WRITE_INTO_A_LOG: f"{SHOWN[url]}: is at a URL, but this command writes into the log; download",
        READ_FILES: f"{SHOWN[url]}: is at a URL, but this command reads files; download",
        NEED_LOCAL_PATHS: f"{SHOWN[url]}: is a URL; name a file or a folder on this machine",
        WRITE_NEW_FILES: f"-o {SHOWN[url]}: is a URL; name a file or a folder on this machine",
    }
    (text,) = [text for lines, text in expected.items() if line in lines]
    assert run(ipsys, line, url).startswith(text)


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # aiohttp closes its connections after the test
@pytest.mark.parametrize("line", READ_LOGS)
def test_command_that_reads_logs_reads_a_url(line: str, here: Path, ipsys: Ipsys) -> None:
    text = run(ipsys, line, HTTPS)
    assert text.startswith(f"{SHOWN[HTTPS]} cannot be read after 2 attempts: "), text


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_check_of_an_unreachable_url_does_not_call_it_broken(here: Path, ipsys: Ipsys) -> None:
    done = ipsys("check", HTTPS)
    assert done.code == 3
    assert done.out.startswith(f"{SHOWN[HTTPS]}: unread: cannot be read after 2 attempts: ")
    assert "broken" not in done.out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # s3fs closes its connections after the test
@pytest.mark.parametrize("line", ["info U", "detect U", "drive --model-from U -o new.mcap"])
def test_missing_object_is_one_line(line: str, bucket: Any, here: Path, ipsys: Ipsys) -> None:
    put(bucket, "other.mcap", b"")
    assert run(ipsys, line, "s3://logs/x.mcap") == "s3://logs/x.mcap does not exist"


def test_every_command_has_a_case() -> None:
    lines = (*WRITE_INTO_A_LOG, *READ_FILES, *NEED_LOCAL_PATHS, *WRITE_NEW_FILES, *READ_LOGS, *REPORT_ERRORS)
    for name in COMMANDS:
        assert any(f"{line} ".startswith(f"{name} ") for line in (*lines, *OTHER)), name
