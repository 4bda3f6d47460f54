"""Images of unexpected sizes."""

import cv2
import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message
from ipsys_log.stages.detect import CORNERS, Detect
from ipsys_log.stages.detect.search import search, search_thoroughly
from tests.stages.drawing import VGA, Look, at_px, calibrated, draw, each_time, frame, jpeg, rig


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2000, 1), (1, 2000), (2, 2), (3, 3), (4, 2)])
def test_a_tiny_picture_has_no_markers(shape: tuple[int, int]) -> None:
    grey = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    assert search(grey, "DICT_4X4_100") == []
    assert search_thoroughly(grey, "DICT_4X4_100") == []


def sent(sizes_px: list[tuple[int, int]]) -> list[Message]:
    """Return frames of a stationary marker, in images of several sizes."""
    picture = draw(VGA, [at_px(VGA, 5, (330, 240), 2.0, 0.3, 0.4)], Look())
    times_ns = each_time(len(sizes_px))
    return [
        frame(jpeg(np.asarray(cv2.resize(picture, size_px), dtype=np.uint8)), time_ns)
        for size_px, time_ns in zip(sizes_px, times_ns, strict=True)
    ]


@pytest.mark.parametrize("corners", CORNERS)
def test_a_size_that_changes_costs_only_those_frames(corners: str) -> None:
    right, wrong = (VGA.width, VGA.height), (320, 240)
    detect = Detect(corners)
    for message in (rig(), calibrated(VGA)):
        assert list(detect(message)) == []
    frames = sent([right, right, wrong, (800, 600), right, right])
    answers = [list(detect(message)) for message in frames]
    (small,), (large,) = answers[2:4]
    assert (small.kind, small.camera, small.timestamp) == ("wrong_size", "red", frames[2].publish_time_ns)
    assert "are 320 x 240 px, its calibration is for 640 x 480" in small.text
    assert "are 800 x 600 px, its calibration is for 640 x 480" in large.text
    found = [[one.id for one in made.markers] for n in (0, 1, 4, 5) for made in answers[n][:1]]
    assert found == [[5]] * 4
    # The result is as without these frames.
    alone = Detect(corners)
    for message in (rig(), calibrated(VGA)):
        list(alone(message))
    for n in (0, 1, 4, 5):
        only, _ = alone(frames[n])
        np.testing.assert_array_equal(answers[n][0].markers[0].corners_px, only.markers[0].corners_px)


@pytest.mark.parametrize("corners", CORNERS)
def test_a_camera_that_does_not_fit_from_the_first_ends_it(corners: str) -> None:
    detect = Detect(corners)
    for message in (rig(), calibrated(VGA)):
        assert list(detect(message)) == []
    with pytest.raises(IpsysError, match="camera red: its frames are 320 x 240 px, its calibration is for"):
        list(detect(*sent([(320, 240)])))
