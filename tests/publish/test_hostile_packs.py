"""Damaged and hostile packs: one line, exit code 1, nothing is written, and nothing is extracted."""

import json
import os
import shutil
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.errors import IpsysError
from ipsys_log.tools.publish.manifest import MAX_MEMBERS, check_member_name
from ipsys_log.tools.publish.opened_pack import copy_pack
from tests.conftest import Ipsys
from tests.publish.packs import change_manifest, change_scores, contents, sign


@pytest.fixture
def refuse(ipsys: Ipsys, temporary: Path) -> Callable[..., None]:
    """Return a check: ``score`` refuses a pack with one line, and leaves no file behind."""

    def check(pack: Path | str, text: str) -> None:
        folder = Path(pack)
        before = contents(folder) if folder.is_dir() else folder.read_bytes() if folder.is_file() else None
        done = ipsys("score", pack)
        assert (done.code, done.out) == (1, "")
        assert text in done.err
        assert len(done.err.splitlines()) == 1, done.err
        assert list(temporary.iterdir()) == []
        after = contents(folder) if folder.is_dir() else folder.read_bytes() if folder.is_file() else None
        assert after == before

    return check


Refuse = Callable[..., None]
OUTSIDE = (
    *("../x.mcap", "logs/../../x.mcap", "/etc/x.mcap", "logs\\x.mcap", "..\\x.mcap", "C:/x.mcap", "C:x.mcap"),
    *(
        "logs//x.mcap",
        "./x.mcap",
        "logs/.x.mcap",
        "~/x.mcap",
        "a\nb",
        "a\x1b[31m",
        "a b",
        "",
        "-o",
        "x" * 201,
    ),
    *("\u202egpm.x", "x.mcap/", "x\x00.mcap"),
)


@pytest.mark.parametrize("name", OUTSIDE)
def test_name_outside_of_the_pack_is_refused(name: str) -> None:
    with pytest.raises(IpsysError, match="names of files in a pack are relative"):
        check_member_name(name, "pack")


@given(st.text("ab./\\:~ -_\n", max_size=12))
def test_accepted_name_stays_in_the_folder(name: str) -> None:
    try:
        check_member_name(name, "pack")
    except IpsysError:
        return
    path = Path(os.path.normpath("/pack/" + name))
    assert path.as_posix() == f"/pack/{name}"
    assert len(path.parts) > 2


@pytest.mark.parametrize("name", OUTSIDE[:6])
def test_archive_with_a_name_outside_is_refused(
    packed: Path, tmp_path: Path, name: str, refuse: Refuse
) -> None:
    bad = Path(shutil.copy(packed / "dataset.zip", tmp_path / "bad.zip"))
    with zipfile.ZipFile(bad, "a") as archive:
        archive.writestr(name, b"x")
    refuse(bad, "names of files in a pack are relative")


@pytest.mark.parametrize(
    "name", [*OUTSIDE[:4], "croissant.json", "SHA256SUMS", "README.md/x", "LOGS/lab.mcap"]
)
def test_manifest_with_a_wrong_name_is_refused(dataset: Path, name: str, refuse: Refuse) -> None:
    table = json.loads((dataset / "croissant.json").read_text())
    table["distribution"].append({**table["distribution"][0], "contentUrl": name})
    (dataset / "croissant.json").write_text(json.dumps(table))
    refuse(
        dataset,
        "twice" if name in ("croissant.json", "SHA256SUMS", "README.md/x", "LOGS/lab.mcap") else "relat",
    )


def test_symbolic_links_are_refused(dataset: Path, tmp_path: Path, refuse: Refuse) -> None:
    readme = dataset / "README.md"
    shutil.move(readme, tmp_path / "elsewhere")
    readme.symlink_to(tmp_path / "elsewhere")
    refuse(dataset, "README.md is a symbolic link")
    readme.unlink()
    (dataset / "logs2").symlink_to(dataset / "logs", target_is_directory=True)
    refuse(dataset, "logs2 is a symbolic link")


def test_pipe_in_a_folder_is_not_opened(dataset: Path, refuse: Refuse) -> None:
    os.mkfifo(dataset / "pipe")
    refuse(dataset, "pipe is not a regular file")


def rewrite(source: Path, target: Path, change: Callable[[zipfile.ZipInfo], None]) -> Path:
    """Copy an archive, with a change of the entry of each member."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for info in old.infolist():
            data = old.read(info)
            change(info)
            new.writestr(info, data)
    return target


def test_link_in_an_archive_is_refused(packed: Path, tmp_path: Path, refuse: Refuse) -> None:
    def link(info: zipfile.ZipInfo) -> None:
        if info.filename == "README.md":
            info.external_attr = (stat.S_IFLNK | 0o777) << 16

    refuse(
        rewrite(packed / "dataset.zip", tmp_path / "l.zip", link), "README.md is a symbolic link or a device"
    )


def test_unusual_compression_is_refused(packed: Path, tmp_path: Path, refuse: Refuse) -> None:
    def compress(info: zipfile.ZipInfo) -> None:
        info.compress_type = zipfile.ZIP_LZMA

    refuse(rewrite(packed / "dataset.zip", tmp_path / "c.zip", compress), "has an unusual compression")


def test_encrypted_archive_is_refused(packed: Path, tmp_path: Path, refuse: Refuse) -> None:
    data = bytearray((packed / "dataset.zip").read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    (tmp_path / "e.zip").write_bytes(data)
    refuse(tmp_path / "e.zip", "is encrypted; give the pack without a password")


@pytest.fixture
def unopened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no member of an archive be opened."""

    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError("a member was opened")

    monkeypatch.setattr(zipfile.ZipFile, "open", fail)


def add_members(archive: Path, count: int, data: bytes, compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(archive, "a", compression) as file:
        for number in range(count):
            file.writestr(f"x{number}", data)
    return archive


def test_compression_bomb_is_not_opened(
    packed: Path, tmp_path: Path, refuse: Refuse, request: pytest.FixtureRequest
) -> None:
    bomb = Path(shutil.copy(packed / "dataset.zip", tmp_path / "bomb.zip"))
    add_members(bomb, 1, bytes(30_000_000), zipfile.ZIP_DEFLATED)
    request.getfixturevalue("unopened")
    refuse(bomb, "x0: would be 30.0 MB from 29.2 kB, more than 100 times its size in the archive")


def test_bomb_of_overlapping_members_is_not_opened(
    packed: Path, tmp_path: Path, refuse: Refuse, request: pytest.FixtureRequest
) -> None:
    """All entries of the table share the bytes of one member, whose own ratio is 1."""
    bomb = Path(shutil.copy(packed / "dataset.zip", tmp_path / "bomb.zip"))
    with zipfile.ZipFile(bomb, "a") as archive:
        archive.writestr("x0", bytes(200_000))
        for number in range(1, 900):
            entry = zipfile.ZipInfo(f"x{number}")
            whole = archive.getinfo("x0")
            entry.header_offset, entry.CRC = whole.header_offset, whole.CRC
            entry.file_size = entry.compress_size = whole.file_size
            archive.filelist.append(entry)
    request.getfixturevalue("unopened")
    refuse(bomb, "bomb.zip: would be 180.0 MB from")


def test_too_many_members_are_refused(
    packed: Path, dataset: Path, tmp_path: Path, refuse: Refuse, request: pytest.FixtureRequest
) -> None:
    many = Path(shutil.copy(packed / "dataset.zip", tmp_path / "many.zip"))
    add_members(many, MAX_MEMBERS, b"")
    for number in range(MAX_MEMBERS):
        (dataset / f"x{number}").touch()
    request.getfixturevalue("unopened")
    refuse(many, "many.zip: has more than 1000 files")
    refuse(dataset, "dataset: has more than 1000 files")


def test_large_table_of_an_archive_is_not_read(tmp_path: Path, refuse: Refuse) -> None:
    """Before any check of an entry, zipfile reads the whole table, with the size that the archive states."""
    size = 50_000_000
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 1, 1, size, 0, 0)
    with (tmp_path / "table.zip").open("wb") as file:
        file.truncate(size)
        file.seek(size)
        file.write(end)
    refuse(tmp_path / "table.zip", "its table of files is too large for a pack")


@settings(max_examples=60)
@given(data=st.data())
def test_changed_byte_of_any_file_is_found(packed: Path, data: st.DataObject, tmp_path_factory: Any) -> None:
    whole = contents(packed / "dataset")
    folder = tmp_path_factory.mktemp("changed")
    shutil.copytree(packed / "dataset", folder / "pack")
    name = data.draw(st.sampled_from(sorted(whole)))
    place = data.draw(st.integers(0, len(whole[name]) - 1))
    changed = bytearray(whole[name])
    changed[place] ^= data.draw(st.integers(1, 255))
    (folder / "pack" / name).write_bytes(changed)
    (folder / "copy").mkdir()
    with pytest.raises(IpsysError) as error:
        copy_pack(folder / "pack", folder / "copy")
    assert len(str(error.value).splitlines()) == 1
    shutil.rmtree(folder)


@settings(max_examples=60)
@given(data=st.data())
def test_damaged_archive_is_refused_or_equal(
    packed: Path, data: st.DataObject, tmp_path_factory: Any
) -> None:
    """Some bytes of an archive mean nothing, such as the time of a member."""
    folder = tmp_path_factory.mktemp("damaged")
    whole = bytearray((packed / "dataset.zip").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        # The table at the end has more meaning per byte than the log.
        place = data.draw(
            st.one_of(st.integers(0, len(whole) - 1), st.integers(len(whole) - 600, len(whole) - 1))
        )
        whole[place] ^= data.draw(st.integers(1, 255))
    whole = whole[: data.draw(st.one_of(st.just(len(whole)), st.integers(0, len(whole))))]
    (folder / "pack.zip").write_bytes(whole)
    (folder / "copy").mkdir()
    fault = ""
    try:
        copy_pack(folder / "pack.zip", folder / "copy")
    except IpsysError as error:
        fault = str(error)
    assert len(fault.splitlines()) == 1 or contents(folder / "copy") == contents(packed / "dataset")
    shutil.rmtree(folder)


def test_missing_and_extra_files_are_named(dataset: Path, refuse: Refuse) -> None:
    (dataset / "mine.py").write_text("raise SystemExit('this code was run')")
    refuse(dataset, "mine.py is not in the manifest; remove the file")
    (dataset / "mine.py").unlink()
    (dataset / "logs/lab.mcap").unlink()
    refuse(dataset, "logs/lab.mcap is missing; download the pack again")
    (dataset / "SHA256SUMS").unlink()
    refuse(dataset, "SHA256SUMS, logs/lab.mcap are missing")
    (dataset / "croissant.json").unlink()
    refuse(dataset, "has no croissant.json; give the folder or the .zip of ipsys pack")
    refuse(dataset / "README.md", "is not a pack")
    refuse(dataset / "nothing", "does not exist")


DEEP = b'{"a":' * 100_000 + b"1" + b"}" * 100_000


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (DEEP, "croissant.json: is nested too deep"),
        (b"[" * 200_000, "croissant.json: is nested too deep"),
        (b"not json", "croissant.json: is not valid JSON: Expecting value: line 1 column 1"),
        (b"\xff\xfe", "croissant.json: is not valid JSON"),
        (b'{"ipsys:packVersion": NaN}', "NaN is not a number"),
        (b'{"ipsys:packVersion": 1e999}', "1e999 is too large"),
        (b'{"ipsys:packVersion": ' + b"9" * 5000 + b"}", "croissant.json: is not valid JSON"),
        (b"[]", "croissant.json: is not a JSON object"),
        (b"{}", "croissant.json: is not the manifest of a pack"),
        (b'{"ipsys:packVersion": true}', "croissant.json: is not the manifest of a pack"),
        (b'{"ipsys:packVersion": 2}', "has version 2, and this ipsys reads 1; update ipsys"),
        (b'{"ipsys:packVersion": 1, "name": "a"}', "distribution is not a list"),
        (b'{"ipsys:packVersion": 1, "name": "a", "distribution": []}', "names no log or no scores.json"),
        (b'{"ipsys:packVersion": 1, "name": "a", "distribution": [3]}', "file 1 needs the texts"),
        (b" " * (1 << 20) + b"{}", "croissant.json has 1.0 MB, more than a pack needs"),
    ],
)
def test_wrong_manifest_is_refused(dataset: Path, data: bytes, text: str, refuse: Refuse) -> None:
    (dataset / "croissant.json").write_bytes(data)
    refuse(dataset, text)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda table: table.update(version=2), "scores.json: has version 2, and this ipsys reads 1; update"),
        (lambda table: table.update(scores=[]), "scores.json: has no list of scores"),
        (lambda table: table["scores"].append(table["scores"][0]), "states a score twice"),
        (lambda table: table["scores"][0].update(mean_mm=-1), "score 1: mean_mm is -1"),
        (lambda table: table["scores"][0].update(tolerance_mm=None), "score 1: tolerance_mm is None"),
        (lambda table: table["scores"][0].update(mean_mm=10**400), "score 1: mean_mm is 1000"),
        (lambda table: table["scores"][1].update(points="3"), "score 2: points is 3"),
        (lambda table: table["scores"][0].update(code="x"), "score 1: does not have the fields"),
        (
            lambda table: table["scores"][0].update(model="mine.py:Estimator"),
            "model 'mine.py:Estimator' is not",
        ),
        (lambda table: table["scores"][0].update(model="\x1b[31m"), r"model '\x1b[31m' is not known; update"),
    ],
)
def test_wrong_scores_are_refused(
    dataset: Path, change: Callable[[dict[str, Any]], object], text: str, refuse: Refuse
) -> None:
    change_scores(dataset, change)
    refuse(dataset, text)


def test_stated_size_and_checksum_are_compared(dataset: Path, refuse: Refuse) -> None:
    change_manifest(dataset, lambda table: table["distribution"][0].update(name="changed"))
    with (dataset / "README.md").open("a") as file:
        file.write("more")
    refuse(dataset, "README.md has ")
    sign(dataset)
    lines = (dataset / "SHA256SUMS").read_text().splitlines(keepends=True)
    (dataset / "SHA256SUMS").write_text("".join(lines[1:]))
    refuse(dataset, "SHA256SUMS and croissant.json contradict each other at README.md")


def test_damaged_log_with_valid_checksums_is_an_error(dataset: Path, refuse: Refuse) -> None:
    (dataset / "logs/lab.mcap").write_bytes(b"no log")
    sign(dataset)
    refuse(dataset, f"ipsys: {dataset}: logs/lab.mcap is not an MCAP file")


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("zip://a.mcap::https://example.org/x.zip", "chained addresses (::) are refused"),
        ("https://example.org/a::b.zip", "chained addresses (::) are refused"),
        ("filecache::s3://bucket/x.zip", "chained addresses (::) are refused"),
        ("reference://x.zip", "this address is refused"),
        ("reference:x.zip", "this address is refused"),
        ("file:///etc/passwd", "this address is refused"),
        ("local:///x.zip", "this address is refused"),
        ("memory://x.zip", "this address is refused"),
        ("ssh://host/x.zip", "this address is refused"),
        ("https:x.zip", "this address is refused"),
        (
            "https://user:secret@example.org/x",
            "https://user:***@example.org/x: a dataset at an address must be a",
        ),
    ],
)
def test_address_is_refused_without_a_connection(
    address: str, text: str, refuse: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError("the address was opened")

    monkeypatch.setattr("fsspec.open", fail)
    refuse(address, text)


def test_folder_around_all_files_is_accepted(packed: Path, tmp_path: Path) -> None:
    """Archives of other programs have the folder itself, with an entry of its own."""
    shutil.make_archive(str(tmp_path / "whole"), "zip", packed, "dataset")
    (tmp_path / "copy").mkdir()
    copy_pack(tmp_path / "whole.zip", tmp_path / "copy")
    assert contents(tmp_path / "copy") == contents(packed / "dataset")
