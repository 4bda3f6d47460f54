"""Packs of a small log, made once."""

import shutil
from pathlib import Path

import pytest

from ipsys_log.tools.publish.packing import pack
from tests.publish.packs import SCORED, write_card, write_points_log
from tests.shared_files import make_once


@pytest.fixture(scope="session")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the log ``lab.mcap``, its packs ``dataset`` and ``dataset.zip``, and the card."""

    def write(folder: Path) -> None:
        log, card = write_points_log(folder / "lab.mcap"), write_card(folder / "card.toml")
        for name in ("dataset", "dataset.zip"):
            pack([log], folder / name, card, models=SCORED)

    return make_once(tmp_path_factory, "packed", write)


@pytest.fixture
def dataset(packed: Path, tmp_path: Path) -> Path:
    """Copy the pack, to be changed."""
    return Path(shutil.copytree(packed / "dataset", tmp_path / "dataset"))


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of temporary files, which is empty at first."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder
