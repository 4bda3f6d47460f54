"""Commands that write new files from logs at URLs, and logs without write permission."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from ipsys_log.api import python_api as api
from ipsys_log.app.cli.lab_inputs import load_calibrations
from ipsys_log.engine.output import choose_target
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogUrl
from tests.conftest import ROOT, Ipsys, small_disk
from tests.log.range_server import Store

PAPER_LAB = ROOT / "sample_logs" / "paper_lab.mcap"
GOLDEN = ROOT / "tests" / "golden" / "v0_1_0.mcap"
# aiohttp closes its connections after the test.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("cut", "{}", "--cameras", "red", "-o", "{out}"),
        ("merge", "{red}", "{white}", "--offset", "white=0.5", "-o", "{out}"),
    ],
)
def test_new_log_from_a_url_is_that_from_the_file(
    words: tuple[str, ...], store: Store, here: Path, ipsys: Ipsys
) -> None:
    local = {"": here / "lab.mcap"}
    shutil.copy(GOLDEN, local[""])
    for camera in ("red", "white") if "merge" in words else ():
        local[camera] = here / f"{camera}.mcap"
        without = ("--exclude-topics", "/measurements") if camera == "white" else ()
        assert ipsys("cut", GOLDEN, "--cameras", camera, "-o", local[camera], *without).code == 0
    urls = {name: store.put(f"/{path.name}", path.read_bytes()) for name, path in local.items()}
    for logs, output in ((local, "local.mcap"), (urls, "remote.mcap")):
        named = {name: log for name, log in logs.items() if name}
        done = ipsys(*(word.format(logs[""], out=output, **named) for word in words))
        assert done.code == 0, done.err
    assert Path("remote.mcap").read_bytes() == Path("local.mcap").read_bytes()


# Two evaluations.
@pytest.mark.slow
def test_model_and_intrinsics_come_from_a_url(store: Store, here: Path, ipsys: Ipsys) -> None:
    model = Path(shutil.copy(PAPER_LAB, here / "model.mcap"))
    api.replay(model, models=("rigid",), until="fit")
    url = store.put("/model.mcap", model.read_bytes())
    for place, output in ((model, "local.mcap"), (url, "remote.mcap")):
        done = ipsys(
            *("locate", PAPER_LAB, "--model-from", place, "--calibration", place, "-o", output, "--json")
        )
        assert done.code == 0, done.err
    assert Path("remote.mcap").read_bytes() == Path("local.mcap").read_bytes()


def test_rig_file_of_a_log_at_a_url(store: Store, here: Path, ipsys: Ipsys) -> None:
    url = store.put("/lab.mcap", PAPER_LAB.read_bytes())
    for place, name in ((PAPER_LAB, "local.toml"), (url, "remote.toml")):
        done = ipsys("init", name, "--from", place)
        assert done.code == 0, done.err
    assert Path("remote.toml").read_text() == Path("local.toml").read_text()


def test_intrinsics_of_one_camera_come_from_a_url(store: Store, here: Path) -> None:
    url = f"{store.put('/lab.mcap', GOLDEN.read_bytes())}?signature=a=b"
    with Session([GOLDEN]) as session:
        cameras = [*session.calibrations]
    texts = [
        encode(load_calibrations([f"{cameras[0]}={place}"], lambda: cameras)[cameras[0]])
        for place in (GOLDEN, url)
    ]
    assert texts[0] == texts[1]
    assert [*load_calibrations([url], lambda: cameras)] == cameras
    with pytest.raises(IpsysError, match=r"/red.yaml: is at a URL, where only a log \(.mcap\) can be read"):
        load_calibrations([f"red={store.address}/red.yaml?secret"], lambda: cameras)


def test_log_without_write_permission_gets_a_derived_log(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests may run with all rights, so the answer of the system is replaced."""
    (here / "archive").mkdir()
    log = Path(shutil.copy(PAPER_LAB, here / "archive" / "monday.mcap"))
    assert choose_target([log], None) == ([log], None)
    for denied in (log, log.parent):
        monkeypatch.setattr(os, "access", lambda path, mode, denied=denied: path != denied or mode != os.W_OK)
        assert choose_target([log], None) == ([log], Path("monday.derived.mcap"))
        assert choose_target([log], Path("other.mcap")) == ([log], Path("other.mcap"))
    assert choose_target([log], None, here) == ([log], here / "monday.derived.mcap")


@pytest.mark.slow
def test_results_of_a_read_only_disk_come_into_the_working_folder(here: Path, ipsys: Ipsys) -> None:
    with small_disk(here / "disk", 8) as disk:
        log = Path(shutil.copy(PAPER_LAB, disk / "monday.mcap"))
        remount = ["mount", "-o", "remount,ro", str(disk)]
        if subprocess.run(remount, capture_output=True, check=False).returncode != 0:
            pytest.skip("no right to mount a disk again")
        (here / "work").mkdir()
        os.chdir(here / "work")
        first = ipsys("evaluate", log, "--model", "rigid", "--json")
        assert first.code == 0, first.err
        assert [path.name for path in Path().iterdir()] == ["monday.derived.mcap"]
        written = Path("monday.derived.mcap").read_bytes()
        second = ipsys("evaluate", log, "--model", "rigid")
        assert second.code == 0, second.err
        assert Path("monday.derived.mcap").read_bytes() == written
        assert log.read_bytes() == PAPER_LAB.read_bytes()
        page = ipsys("report", log, "--model", "rigid")
        assert page.code == 0, page.err
        assert Path("monday.html").is_file()
        os.chdir(here)


@pytest.mark.parametrize(
    ("key", "name"),
    [("lab/2026-05/a.mcap", "2026-05/a.mcap"), ("lab/../../etc/a.mcap", "a.mcap"), ("lab//a.mcap", "a.mcap")],
)
def test_derived_log_keeps_the_folders_of_a_pattern(key: str, name: str, here: Path) -> None:
    log = LogUrl("s3://lab/*/a.mcap", key)
    derived = here / "out" / name.replace("a.mcap", "a.derived.mcap")
    assert choose_target([log], None, here / "out") == ([log], derived)
