"""Stages in one pass over a log: the bytes of one stage after the other, and results only for their input."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Marker, Markers, Message, Rig
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, channel_of
from ipsys_log.pipeline import replay
from ipsys_log.runs import execute
from ipsys_log.runs import replay as stages_in_order
from ipsys_log.runs.execute import compute_messages
from ipsys_log.runs.graph import Task, plan_stage, writer_of
from ipsys_log.runs.one_pass import OnePass
from ipsys_log.runs.options import Request
from ipsys_log.runs.output import append_messages, write_log
from ipsys_log.stages.camera_frame import CameraFrame
from tests.geometry.squares import CENTRE, FISHEYE, corners_px, turned

DETECT, CAMERA_FRAME = writer_of(MARKERS), writer_of(CAMERA_POINTS)
STAGES = [DETECT.name, CAMERA_FRAME.name]
MARKER = Marker(3, corners_px(FISHEYE, turned(0.3), np.array(CENTRE)))


@pytest.mark.slow
def test_one_pass_has_the_bytes_of_single_stages(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = Path(shutil.copy(lab, tmp_path / "alone.mcap"))
    replay([lab], Request())
    monkeypatch.setattr(OnePass, "follow", lambda self, messages, *_: messages)
    replay([alone], Request())
    assert lab.read_bytes() == alone.read_bytes()


@pytest.mark.slow
def test_model_of_another_log_lets_all_stages_follow(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, alone = (Path(shutil.copy(lab, tmp_path / f"{name}.mcap")) for name in ("other", "alone"))
    replay([other], Request(models=("rigid",)), "fit")
    computed: list[str] = []

    def watched(task: Task, *rest: Any) -> Iterator[Message]:
        computed.append(task.stage.name)
        return compute_messages(task, *rest)

    monkeypatch.setattr(stages_in_order, "compute_messages", watched)
    request = Request(models=("rigid",), model_from=other)
    fresh = [outcome.stage for outcome in replay([lab], request) if outcome.fresh]
    assert fresh == ["detect", "camera-frame", "fit", "evaluate", "locate", "fuse"]
    assert computed == ["detect", "fit", "evaluate"]
    monkeypatch.setattr(OnePass, "follow", lambda self, messages, *_: messages)
    replay([alone], request)
    assert computed[3:] == fresh
    assert lab.read_bytes() == alone.read_bytes()


@pytest.mark.slow
def test_one_pass_does_not_read_its_own_markers(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: set[Any] = set()
    messages = Session.messages

    def watched(self: Session, topics: Collection[str], *span: int | None) -> Iterator[Message]:
        read.update(channel_of(topic, Markers) for topic in topics)
        return messages(self, topics, *span)

    monkeypatch.setattr(Session, "messages", watched)
    replay([lab], Request(), STAGES[1])
    assert read
    assert MARKERS not in read


@pytest.mark.slow
def test_failure_of_a_following_stage_keeps_the_first_run(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Path(shutil.copy(lab, tmp_path / "whole.mcap"))
    replay([whole], Request(), STAGES[1])

    def fail(*_: object) -> None:
        raise IpsysError("the rig has no marker length")

    with monkeypatch.context() as patch:
        patch.setattr(CameraFrame, "_frame", fail)
        with pytest.raises(IpsysError, match="no marker length"):
            replay([lab], Request(), STAGES[1])
    with Session([lab]) as session:
        assert [run.stage for run in session.runs()] == STAGES[:1]
    outcomes = replay([lab], Request(), STAGES[1])
    assert [outcome.fresh for outcome in outcomes] == [False, True]
    assert lab.read_bytes() == whole.read_bytes()


@pytest.mark.slow
def test_results_are_computed_again_after_a_change(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process appends a rig between two stages: the points must be those of the new rig."""
    alone = Path(shutil.copy(lab, tmp_path / "alone.mcap"))
    run_stage = execute.run_stage

    def run_and_append(session: Session, target: Path, task: Task, *rest: Any) -> Any:
        outcome = run_stage(session, target, task, *rest)
        if task.stage is DETECT:
            (rig,) = session.messages(["/rig"])
            longer = Message("/rig", rig.log_time_ns + 1, rig.publish_time_ns, _longer(rig))
            append_messages(target, [longer])
        return outcome

    monkeypatch.setattr(stages_in_order, "run_stage", run_and_append)
    replay([lab], Request(), STAGES[1])
    monkeypatch.setattr(OnePass, "follow", lambda self, messages, *_: messages)
    replay([alone], Request(), STAGES[1])
    assert lab.read_bytes() == alone.read_bytes()


def _longer(message: Message) -> Rig:
    rig: Rig = message.payload
    return Rig(rig.name, rig.dictionary, 2 * rig.marker_length_m, rig.markers)


def _rows(messages: Iterator[Message]) -> list[tuple[str, int, int, bytes]]:
    return [(m.topic, m.log_time_ns, m.publish_time_ns, encode(m.payload)) for m in messages]


few_times = st.lists(st.integers(0, 6), min_size=1, max_size=6)


@settings(max_examples=12, deadline=None)
@given(few_times, few_times)
def test_recorded_messages_keep_their_place(rig_times: list[int], marker_times: list[int]) -> None:
    """As in the log: a rig comes before markers of the same log time; the first one holds from the start."""
    rigs = [
        Message("/rig", time_ns, time_ns, Rig("lab", "DICT_4X4_100", 0.1 + 0.01 * number))
        for number, time_ns in enumerate(sorted(rig_times))
    ]
    lens = Message("/cameras/red/calibration", 0, 0, FISHEYE, "red")
    markers = [
        Message("/runs/edges/cameras/red/markers", time_ns, number, _markers(number), "red")
        for number, time_ns in enumerate(sorted(marker_times))
    ]
    leader = Task(stage=DETECT, run="edges", step=lambda run: lambda message: ())
    with tempfile.TemporaryDirectory() as folder, OnePass(Request(), CAMERA_FRAME) as one_pass:
        path = Path(folder) / "log.mcap"
        write_log(path, sorted([lens, *rigs], key=lambda message: message.log_time_ns))
        with Session([path]) as session:
            assert list(one_pass.follow(markers, session, leader, "edges", [CAMERA_FRAME])) == markers
        append_messages(path, markers)
        with Session([path]) as session:
            task = plan_stage(CAMERA_FRAME, session, {}, {MARKERS: "edges"})
            assert isinstance(task, Task)
            alone = _rows(compute_messages(task, session, "edges", lambda *_: None))
            waiting = one_pass.results(session, task, "edges", lambda *_: None)
            assert waiting is not None
            assert _rows(waiting) == alone
            assert len(alone) == len(markers)
            assert one_pass.results(session, task, "edges_2", lambda *_: None) is None
        append_messages(path, markers[-1:])
        with Session([path]) as session:
            assert one_pass.results(session, task, "edges", lambda *_: None) is None


def _markers(time_ns: int) -> Markers:
    return Markers(time_ns, (MARKER,), FISHEYE.width, FISHEYE.height)
