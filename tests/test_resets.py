"""Resets of detection at absolute log times: live, in a replay, and in pieces."""

from dataclasses import replace
from pathlib import Path

import pytest

from ipsys_log.engine.request import Request
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Markers, Message
from ipsys_log.messages.stage import Resets
from ipsys_log.stages.detect import Detect
from ipsys_log.tools.verify import verify
from ipsys_log.units import NS_PER_S
from tests.live_recordings import attached_in_steps, sent
from tests.stages.drawing import FISHEYE, Look, at_px, calibrated, draw, frame, jpeg, rig

RESETS = Resets(30 * NS_PER_S)
REQUEST = Request(parameters={"reset_s": "1"})


def test_live_equals_replay_across_resets(lab_log: Path, tmp_path: Path) -> None:
    target = tmp_path / "live.mcap"
    frames = {camera: images[:12] for camera, images in sent(lab_log).items()}
    attached, settings, clock = attached_in_steps(lab_log, frames)
    with attached:
        pipeline.live(attached, settings, target, REQUEST, "detect", sinks=[clock.watch])
    (outcome,) = pipeline.replay([target], REQUEST, "detect")
    assert not outcome.fresh
    with Session([target]) as session:
        (run,) = session.runs()
        times_ns = [m.log_time_ns for m in session.messages([session.images["red"]])]
    assert run.parameters["reset_s"] == "1"
    assert len({Resets(NS_PER_S).number("red", time_ns) for time_ns in times_ns}) > 1
    assert all(one.equal and one.left > 0 for one in verify([target], None, lambda *_: None))


def test_markers_after_a_reset_do_not_depend_on_earlier_frames() -> None:
    start_ns = RESETS.start_ns("red", 56_666_666)
    step_ns = NS_PER_S // 30
    film = [
        frame(
            jpeg(draw(FISHEYE, [at_px(FISHEYE, 5, (900 + 4 * n, 500))], Look(seed=3 + n))),
            start_ns + n * step_ns,
        )
        for n in range(-3, 3)
    ]
    film = [replace(message, log_time_ns=message.publish_time_ns) for message in film]
    whole = _corners(film)
    assert _corners(film[3:]) == whole[3:]
    # The frame before the reset has earlier frames, and its corners depend on them.
    assert _corners(film[2:])[0] != whole[2]


def _corners(film: list[Message]) -> list[bytes]:
    detect = Detect("edges", RESETS)
    for message in (rig(), calibrated(FISHEYE)):
        assert list(detect(message)) == []
    found = [payload for message in film for payload in detect(message) if isinstance(payload, Markers)]
    return [b"".join(marker.corners_px.tobytes() for marker in one.markers) for one in found]


def test_parameter_of_a_record_that_is_no_period_is_refused(lab: Path) -> None:
    for text in ("0", "-1", "x", "1e3", "999999999"):
        with pytest.raises(IpsysError, match="reset_s"):
            pipeline.replay([lab], Request(parameters={"reset_s": text}), "detect")
