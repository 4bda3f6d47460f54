"""Blurred images: sharp markers, blocks of one grey level elsewhere, and scores of their own."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import IMAGES, MARKERS
from ipsys_log.tools.publish.kept_contents import blur_image
from ipsys_log.tools.publish.packing import pack
from ipsys_log.tools.publish.scoring import score
from ipsys_log.vision.decode import decode_grey
from tests.conftest import Ipsys


@given(st.integers(40, 300), st.integers(40, 300), st.integers(0, 2**32 - 1))
def test_marker_and_its_border_stay_sharp(width: int, height: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grey = rng.integers(0, 256, (height, width)).astype(np.uint8)
    centre, half = rng.uniform([0, 0], [width, height]), rng.uniform(4, 15)
    corners = centre + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    blurred = blur_image(grey, [corners])
    rows, columns = np.mgrid[:height, :width]
    beside = np.maximum(abs(columns - centre[0]), abs(rows - centre[1])) / half
    assert (blurred == grey)[beside < 1.3].all()
    assert blurred.shape == grey.shape


def test_blocks_hide_all_details() -> None:
    """Images with equal means of blocks give equal results: the details cannot be computed back."""
    grey = np.kron(np.arange(48, dtype=np.uint8)[None] * 4 + 40, np.ones((96, 4), np.uint8)).astype(np.uint8)
    details = grey.copy()
    details[::2, ::2] += 10
    details[1::2, 1::2] -= 10
    assert not np.array_equal(details, grey)
    assert np.array_equal(blur_image(details, []), blur_image(grey, []))


# Markers are detected in all images.
@pytest.mark.slow
def test_blurred_pack_has_scores_of_its_own(detected_log: Path, packed: Path, tmp_path: Path) -> None:
    log = Path(shutil.copy(detected_log, tmp_path / "lab.mcap"))
    done = pack([log], tmp_path / "dataset", packed / "card.toml", models=["rigid"], blur=True)
    assert "blurred outside of the markers, in grey" in (tmp_path / "dataset/README.md").read_text()
    assert score(tmp_path / "dataset").as_stated
    with Session([log]) as sharp, Session([tmp_path / "dataset/logs/lab.mcap"]) as blurred:
        assert [run for run in blurred.run_names() if blurred.topics(MARKERS, run)] == []
        for topic in sharp.topics(IMAGES):
            pairs = zip(sharp.messages([topic]), blurred.messages([topic]), strict=True)
            for one, other in pairs:
                assert one.log_time_ns == other.log_time_ns
                before, after = decode_grey(one.payload).astype(int), decode_grey(other.payload).astype(int)
                assert before.shape == after.shape
                # Most pixels are not beside a marker.
                assert (abs(before - after) > 3).mean() > 0.02
    whole = pack([log], tmp_path / "whole", packed / "card.toml", models=["rigid"])
    for own, sharp_score in zip(done.scores, whole.scores, strict=True):
        assert own.key == sharp_score.key
        assert own.mean_mm == pytest.approx(sharp_score.mean_mm, abs=0.5)


def test_blur_without_markers_or_images_is_refused(
    lab_log: Path, packed: Path, tmp_path: Path, ipsys: Ipsys
) -> None:
    with pytest.raises(IpsysError, match="which --blur keeps sharp; run: ipsys replay --until detect"):
        pack([lab_log], tmp_path / "x", packed / "card.toml", blur=True)
    arguments = ("pack", lab_log, "-o", tmp_path / "x", "--card", packed / "card.toml", "--blur")
    done = ipsys(*arguments, "--without-images")
    assert (done.code, "cannot be used together" in done.err) == (1, True)
    assert list(tmp_path.iterdir()) == []
