"""A command that fails leaves no run behind: one case for each kind of input that the stages check.

The tests of the functions have the further cases.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CameraCalibration,
    CameraPoints,
    CompressedImage,
    Distance,
    Markers,
    Measurement,
    Message,
    Model,
    Rig,
    WorldPoint,
)
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import scale_intrinsics
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys
from tests.test_bad_input import refused

PAPER = ROOT / "sample_logs" / "paper_lab.mcap"

Change = Callable[[Message], Message | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A log with a fault, and the command that refuses it.

    Attributes
    ----------
    said : a part of the one line.
    change : of each message of the log.
    command : with LOG for the log, and MODEL for a log with a fitted model.
    log : fixture of the log: without frames, with images or with video.
    before : a command that must succeed first; with ``late``, before the change.
    change_model : of each message of the log with the fitted model.
    """

    said: str
    change: Change = lambda message: message
    command: str = "replay LOG --model poly"
    log: str = "paper"
    before: str = ""
    late: bool = False
    change_model: Change = lambda message: message


def without(kind: type) -> Change:
    return lambda message: None if isinstance(message.payload, kind) else message


def edit(kind: type, change: Callable[[Any], Any]) -> Change:
    def changed(message: Message) -> Message:
        if not isinstance(message.payload, kind):
            return message
        return replace(message, payload=change(message.payload))

    return changed


def tape(*distances: Distance, side: str | None = "left") -> Change:
    return edit(Measurement, lambda m: replace(m, distances=distances, side=side) if m.id == "s003" else m)


def to(measurement: str, **fields: Any) -> Change:
    return edit(Measurement, lambda m: replace(m, **fields) if m.id == measurement else m)


def rig(**fields: Any) -> Change:
    return edit(Rig, lambda one: replace(one, **fields))


def lens_of(**fields: Any) -> Change:
    return edit(CameraCalibration, lambda lens: replace(lens, **fields))


def places(point_m: Callable[[int], tuple[float, float, float]]) -> Change:
    """Give each measurement a world point, by its number."""

    def moved(m: Measurement) -> Measurement:
        return replace(m, point=WorldPoint(*point_m(int(m.id[1:]))), distances=())

    return edit(Measurement, moved)


def red_sees_until(end_s: int) -> Change:
    """Take the markers out of later frames of the camera red; times in s since 1970."""

    def change(message: Message) -> Message:
        if message.camera != "red" or message.publish_time_ns < end_s * NS_PER_S:
            return message
        return edit(Markers, lambda one: replace(one, markers=()))(message) or message

    return change


def again(message: Message, change: Callable[[Any], Any]) -> Message:
    """A second message of a topic, after the end of the log."""
    later_ns = message.log_time_ns + 3600 * NS_PER_S
    return Message(message.topic, later_ns, later_ns, change(message.payload), message.camera)


NO_COVARIANCE = edit(
    Markers,
    lambda one: replace(
        one, markers=tuple(replace(marker, covariance_px2=np.zeros((8, 8))) for marker in one.markers)
    ),
)
WIDER = edit(CameraCalibration, lambda lens: scale_intrinsics(lens, 1920, 1080, "red"))
FAR = edit(
    CameraPoints, lambda one: replace(one, points=tuple(replace(point, x_m=1e9) for point in one.points))
)
NO_PARAMETERS = edit(
    Model, lambda model: replace(model, cameras=tuple(replace(one, parameters=()) for one in model.cameras))
)
OTHER_CAMERAS = edit(
    Model,
    lambda model: replace(
        model, cameras=tuple(replace(one, camera=f"{one.camera}_old") for one in model.cameras)
    ),
)
WIDE = np.array([[0.9, 1, 1], [1, 0.9, 1], [1, 1, 1]])
MODEL_FROM = "replay LOG --model-from MODEL"
A, B = Distance("A", 2.0), Distance("B", 2.0)

CASES: dict[str, Case] = {
    # Settings of the log.
    "no_calibration_edges": Case(
        said="has no calibration in the log, but the corner method edges needs one",
        change=without(CameraCalibration), log="lab", command="detect LOG --corners edges",
    ),
    "dictionary": Case(
        said="dictionary 'DICT_X' of the rig is unknown", change=rig(dictionary="DICT_X"), log="lab"
    ),
    "centre": Case(said="the principal point", change=lens_of(width=1920, height=1080), log="lab"),
    "size_video": Case(
        said="its calibration is for 1920 x 1080", change=WIDER, log="video",
        command="replay LOG --corners stock",
    ),
    "corrupt": Case(
        said="frames can be decoded", log="lab",
        change=edit(CompressedImage, lambda image: replace(image, data=b"no image")),
    ),
    # Names that the user gives.
    "method": Case(said="--method x: is not known", command="replay LOG --method x"),
    "pose": Case(
        said="has no effect, because the log has no markers", before="camera-frame LOG", late=True,
        change=without(Markers), command="replay LOG --method pose",
    ),
    "train_test": Case(said="held out for the evaluation", command="replay LOG --train test"),
    "run_name": Case(
        said="run mine already has the stage fit with other input", before="fit LOG --run mine",
        command="replay LOG --run mine --method pose",
    ),
    # Markers and camera points of other programs.
    "covariance": Case(said="covariance_px2 has no variance", change=NO_COVARIANCE),
    "far_point": Case(said="of marker 0 is impossible", before="camera-frame LOG", late=True, change=FAR),
    # Measurements.
    "two_of_one_id": Case(said="two measurements have the id 's001'", change=to("s002", id="s001")),
    "duplicate": Case(said="are the same pair", before="camera-frame LOG"),
    "one_reference": Case(said="from one reference point", change=tape(A, replace(A, distance_m=1.0))),
    "unknown_reference": Case(
        said="reference point 'C' is not in the rig", change=tape(A, Distance("C", 1.0))
    ),
    "no_side": Case(said="the distances fit on both sides; give the side", change=tape(A, B, side=None)),
    "wrong_side": Case(said="side 'up' of AB is not valid", change=tape(A, B, side="up")),
    "far_place": Case(said="is impossible", change=to("s003", point=WorldPoint(1e9, 0.0, 0.0))),
    # Too few calibration points.
    "one_line": Case(said="points are on one line", change=places(lambda number: (0.01 * number, 1.0, 0.0))),
    "one_place": Case(
        said="needs at least 10 different points, found 2",
        change=places(lambda number: (number % 2, 1.0, 0.0)),
    ),
    "few_of_a_camera": Case(
        said="camera red: poly needs at least 10 calibration points", before="camera-frame LOG",
        change=red_sees_until(1_700_000_008),
        command="replay LOG --model rigid --model poly",
    ),
    "unseen": Case(
        said="no camera saw a calibration point", before="camera-frame LOG",
        change=edit(Measurement, lambda m: replace(m, timestamp=1, still=None)),
    ),
    "no_height": Case(
        said="rayplane needs the height of marker 0 above the floor", change=rig(marker_height_m=None),
        command="replay LOG --model rayplane",
    ),
    # Models of other logs.
    "no_such_model": Case(said="has no fitted model best", command="fit LOG --model best --model-from MODEL"),
    "no_such_model_live": Case(said="has no fitted model best", command=f"{MODEL_FROM} --model best"),
    "no_reason": Case(said="--reason: is missing", command="exclude LOG s001"),
    "other_cameras": Case(said="model is for the cameras", command=MODEL_FROM, change_model=OTHER_CAMERAS),
    "other_lenses": Case(
        said="this is a model of other cameras; calibrate this lab", command=MODEL_FROM,
        change=edit(CameraCalibration, lambda lens: replace(lens, K=lens.K * WIDE)),
    ),
    "incomplete_model": Case(
        said="the stored model poly has no parameter", command=MODEL_FROM, change_model=NO_PARAMETERS
    ),
    "evaluate_unknown_marker": Case(
        said="marker 77, which is not in the rig", command=MODEL_FROM, change=to("s003", marker_id=77)
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def model_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with the fitted model poly."""
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.pipeline import replay

    path = Path(shutil.copy(PAPER, tmp_path_factory.mktemp("model") / "model.mcap"))
    replay([path], Request(models=("poly",)), "fit")
    return path


def duplicated(log: Path) -> tuple[Message, ...]:
    """The first measurement, once more under another name."""
    with Session([log]) as session:
        first = next(session.messages(["/measurements"]))
    return (again(first, lambda one: replace(one, id="twin")),)


@pytest.mark.parametrize("name", CASES)
def test_refused_command_leaves_no_run(
    name: str, ipsys: Ipsys, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    case = CASES[name]
    source = {"lab": "lab_log", "video": "video_log"}.get(case.log)
    start = PAPER if source is None else request.getfixturevalue(source)
    first = Path(shutil.copy(start, tmp_path / "first.mcap"))
    paths: dict[str, Path] = {}
    if "MODEL" in case.command:
        model = Path(shutil.copy(request.getfixturevalue("model_log"), tmp_path / "model.mcap"))
        paths["MODEL"] = rewrite(model, case.change_model).rename(tmp_path / "changed_model.mcap")
    log = (
        first if case.late else rewrite(first, case.change, duplicated(first) if name == "duplicate" else ())
    )
    paths["LOG"] = log

    def words(command: str) -> list[object]:
        return [paths.get(word, word) for word in command.split()]

    if case.before:
        done = ipsys(*words(case.before))
        assert done.code == 0, done.err
    if case.late:
        paths["LOG"] = rewrite(log, case.change)
    assert case.said in refused(ipsys, paths["LOG"], *words(case.command))


def test_second_calibration_that_is_invalid_leaves_no_run(ipsys: Ipsys, lab: Path) -> None:
    with Session([lab]) as session:
        first = next(session.messages(["/cameras/red/calibration"]))
    log = rewrite(lab, lambda message: message, (again(first, lambda lens: replace(lens, D=lens.D[:3])),))
    assert "found 3" in refused(ipsys, log, "replay", log, "--corners", "stock")
