"""A command that fails leaves no run behind: each error that a stage can raise before its first message."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log import errors
from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import scale_intrinsics
from ipsys_log.joint.solver import ConvergenceError
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
    RigMarker,
    WorldPoint,
)
from ipsys_log.runs import checks
from ipsys_log.units import NS_PER_S
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys
from tests.test_bad_input import refused

PAPER = ROOT / "sample_logs" / "paper_lab.mcap"
PACKAGE = ROOT / "ipsys_log"

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
    command: str = "replay LOG"
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
SKEWED = np.array([[500.0, 2.84, 480.0], [0.0, 500.0, 270.0], [0.0, 0.0, 1.0]])
FOLDING = np.array([-1.15, 2.91, -2.48, 0.178])
WIDER = edit(CameraCalibration, lambda lens: scale_intrinsics(lens, 1920, 1080, "red"))
FAR = edit(
    CameraPoints, lambda one: replace(one, points=tuple(replace(point, x_m=1e9) for point in one.points))
)
NO_PARAMETERS = edit(
    Model,
    lambda model: replace(model, cameras=tuple(replace(one, parameters=()) for one in model.cameras)),
)
OTHER_CAMERAS = edit(
    Model,
    lambda model: replace(
        model, cameras=tuple(replace(one, camera=f"{one.camera}_old") for one in model.cameras)
    ),
)
MODEL_FROM = "replay LOG --model-from MODEL"
A, B = Distance("A", 2.0), Distance("B", 2.0)

CASES: dict[str, Case] = {
    # Settings of the log.
    "no_rig": Case(said="has no rig", change=without(Rig)),
    "no_calibration": Case(said="camera black has no calibration", change=without(CameraCalibration)),
    "no_calibration_edges": Case(
        said="has no calibration in the log, but the corner method edges needs one",
        change=without(CameraCalibration), log="lab", command="detect LOG --corners edges",
    ),
    "dictionary": Case(
        said="dictionary 'DICT_X' of the rig is unknown", change=rig(dictionary="DICT_X"), log="lab"
    ),
    "calibration": Case(
        said="takes 4 coefficients, found 3",
        change=edit(CameraCalibration, lambda lens: replace(lens, D=lens.D[:3])),
    ),
    "centre": Case(said="the principal point", change=lens_of(width=1920, height=1080), log="lab"),
    "skew": Case(said="has a skew of 2.84 px", change=lens_of(K=SKEWED), log="lab"),
    "folding": Case(said="turns back inside the image", change=lens_of(D=FOLDING), log="lab"),
    "size": Case(said="its calibration is for 1920 x 1080", change=WIDER, log="lab"),
    "size_stock": Case(
        said="its calibration is for 1920 x 1080", change=WIDER, log="lab",
        command="replay LOG --corners stock",
    ),
    "size_video": Case(
        said="its calibration is for 1920 x 1080", change=WIDER, log="video",
        command="replay LOG --corners stock",
    ),
    "corrupt": Case(
        said="frames can be decoded", log="lab",
        change=edit(CompressedImage, lambda image: replace(image, data=b"no image")),
    ),
    # Names that the user gives.
    "corners": Case(said="--corners x: is not known", command="replay LOG --corners x"),
    "method": Case(said="--method x: is not known", command="replay LOG --method x"),
    "model": Case(said="model 'x' is not known", command="replay LOG --model x"),
    "pose": Case(
        said="has no effect, because the log has no markers", before="camera-frame LOG", late=True,
        change=without(Markers), command="replay LOG --method pose",
    ),
    "train": Case(said="no measurement has the label 'x'", command="replay LOG --train x"),
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
    "no_marker": Case(said="s003 has no marker", change=to("s003", marker_id=None)),
    "unknown_marker": Case(said="marker 77, which is not in the rig", change=to("s003", marker_id=77)),
    "unseen_marker": Case(
        said="marker 7, which no camera saw", before="camera-frame LOG --rig RIG",
        command="replay LOG --rig RIG", change=to("s003", marker_id=7),
    ),
    "duplicate": Case(said="are the same pair", before="camera-frame LOG"),
    "no_distances": Case(said="needs a world point, or two or more distances", change=tape()),
    "one_reference": Case(said="from one reference point", change=tape(A, replace(A, distance_m=1.0))),
    "unknown_reference": Case(
        said="reference point 'C' is not in the rig", change=tape(A, Distance("C", 1.0))
    ),
    "long_tape": Case(said="too long", change=tape(A, Distance("B", 1e9))),
    "no_triangle": Case(
        said="do not meet", change=tape(Distance("A", 0.1), Distance("B", 0.1))
    ),
    "no_side": Case(said="the distances fit on both sides; give the side", change=tape(A, B, side=None)),
    "wrong_side": Case(said="side 'up' of AB is not valid", change=tape(A, B, side="up")),
    "no_distance": Case(said="not all above 0", change=tape(A, B, Distance("B", -1.0))),
    "no_sigma": Case(said="is not a standard deviation", change=tape(A, replace(B, sigma_m=-1.0))),
    "far_place": Case(said="is impossible", change=to("s003", point=WorldPoint(1e9, 0.0, 0.0))),
    # Too few calibration points.
    "few": Case(
        said="poly needs at least 10 calibration points",
        change=lambda m: None if isinstance(m.payload, Measurement) and m.payload.id > "s008" else m,
    ),
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
    "other_cameras": Case(said="model is for the cameras", command=MODEL_FROM, change_model=OTHER_CAMERAS),
    "incomplete_model": Case(
        said="the stored model poly has no parameter", command=MODEL_FROM, change_model=NO_PARAMETERS
    ),
    "evaluate_two_of_one_id": Case(
        said="two measurements have the id", command=MODEL_FROM, change=to("s002", id="s001")
    ),
    "evaluate_no_triangle": Case(
        said="do not meet", command=MODEL_FROM, change=tape(Distance("A", 0.1), Distance("B", 0.1))
    ),
    "evaluate_unknown_marker": Case(
        said="marker 77, which is not in the rig", command=MODEL_FROM, change=to("s003", marker_id=77)
    ),
}  # fmt: skip

# By function, the cases that make it raise; or the reason why no stage raises it before its first message.
_FRAME = "a frame that cannot be decoded is an event"
_FIT = "the checks of fit have refused too few points, and points on a line"
_JOINT = "the fit of joint is appended whole or not at all; only the stages before it keep their runs"
_CHECKED = "the checks of the input have refused such a log"
RAISES: dict[str, tuple[str, ...] | str] = {
    "analysis.joint_calibration.observe": _CHECKED,
    "analysis.joint_evaluation._learning.predict": "the learning curve leaves out such a subset",
    "analysis.pairs._check_duplicates": ("duplicate",),
    "analysis.pairs.active_measurements": ("two_of_one_id", "no_marker", "evaluate_two_of_one_id"),
    "analysis.pairs.build_pairs": ("unknown_marker", "unseen_marker", "evaluate_unknown_marker"),
    "analysis.pairs.gather_sightings": ("far_point",),
    "analysis.pairs.split": ("train", "train_test"),
    "analysis.pairs.valid_measurements": ("no_rig",),
    "analysis.tape._check_lengths": ("long_tape",),
    "analysis.tape._check_point": ("far_place",),
    "analysis.tape._check_sigma": ("no_sigma",),
    "analysis.tape._solved": ("no_distances", "one_reference", "no_triangle", "evaluate_no_triangle"),
    "analysis.tape.reference_points": ("unknown_reference",),
    "calibration.lens_models.find_lens_model": "only the calibration of intrinsics calls it",
    "geometry.lenses.check_calibration": ("calibration",),
    "geometry.lenses.check_size": ("size", "size_stock", "size_video"),
    "geometry.lenses.scale_intrinsics": "only a recorder calls it",
    "geometry.markers.check_covariance": ("covariance",),
    "geometry.plausible_lenses._check_centre": ("centre",),
    "geometry.plausible_lenses._check_matrix": ("skew",),
    "geometry.plausible_lenses.check_plausible": ("folding",),
    "geometry.trilateration._check_numbers": ("no_distance",),
    "geometry.trilateration.multilaterate": ("no_side", "wrong_side"),
    "geometry.trilateration.trilaterate": ("no_triangle",),
    "images.decode._decode_jpeg": ("corrupt",),
    "images.decode._decode_other": ("corrupt",),
    "images.decode._raw_pixels": _FRAME,
    "images.decode.check_pixel_count": _FRAME,
    "images.decode.decode_colour": "only exports of pictures call it",
    "images.jpeg.check_restarts": _FRAME,
    "images.video.Video.__init__": _FRAME,
    "images.video.Video._decode": _FRAME,
    "images.video.Video._next": _FRAME,
    "images.video.decode_keyframe": _FRAME,
    "joint.fit.check_observations": _JOINT,
    "joint.from_messages._point": _CHECKED,
    "joint.from_messages.gather_observations": _CHECKED,
    "joint.locate_step.LocateCorners._locate": _CHECKED,
    "joint.payload._restore": _CHECKED,
    "joint.solver._factorise": _JOINT,
    "joint.solver._follow_valley": _JOINT,
    "joint.solver._more": _JOINT,
    "joint.solver.solve": _JOINT,
    "joint.start._anchor": _JOINT,
    "models.ann.NeuralNetwork.fit": _FIT,
    "models.kriging.Kriging.fit": _FIT,
    "models.ray_models.RayDepth.fit": _FIT,
    "models.ray_models.RayPlane.fit": _FIT,
    "models.rays._fit_group": "the sum of residuals is finite for finite points",
    "models.rigid.RigidTransform.fit": _FIT,
    "models.rigid.rigid_transform": _FIT,
    "models.table.check_name": ("model",),
    "models.table.create": _CHECKED,
    "models.table.fit_cameras": _FIT,
    "models.table.restore": ("incomplete_model",),
    "stages.camera_frame.CameraFrame._settings": ("no_rig", "no_calibration"),
    "stages.camera_frame._plan": ("pose",),
    "stages.StageParameter.check": ("method", "corners"),
    "stages.camera_frame.check_method": "the request has refused such a method",
    "stages.detect.FrameDetector._follow": ("no_calibration_edges",),
    "stages.detect.FrameDetector._frame": ("no_rig",),
    "stages.detect._resets": "the record of a run in a changed log; tests/test_resets.py",
    "stages.detect.reports.Reports.__call__": ("size",),
    "stages.detect.check_corners": "the request has refused such a method",
    "stages.detect.stock.marker_detector": ("dictionary",),
    "analysis.camera_models._check_count": ("few", "few_of_a_camera"),
    "analysis.camera_models._check_spread": ("one_line",),
    "analysis.camera_models.check_different": ("one_place",),
    "analysis.camera_models.check_line": ("one_line",),
    "analysis.camera_models.check_pairs": ("unseen",),
    "analysis.model_kinds.CornerModels.check_points": "tests/joint/test_joint_refusals.py",
    "analysis.model_kinds.PointModels.check_points": ("few",),
    "stages.fuse.Fuse.__call__": ("no_rig",),
    "models.locate_step._height": ("no_height",),
    "stages.smooth._compute": ("no_rig",),
}


@pytest.fixture(scope="module")
def model_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with the fitted model poly."""
    from ipsys_log.pipeline import replay
    from ipsys_log.runs.options import Request

    path = Path(shutil.copy(PAPER, tmp_path_factory.mktemp("model") / "model.mcap"))
    replay([path], Request(), "fit")
    return path


def rig_file(folder: Path, log: Path) -> Path:
    """The rig of a log, with one marker more."""
    with Session([log]) as session:
        one: Rig = session.payloads(["/rig"])[0]
    lines = [f'name = "lab"\ndictionary = "{one.dictionary}"\nmarker_length_m = {one.marker_length_m}']
    for point in one.reference_points:
        lines.append(f'[[reference_points]]\nname = "{point.name}"\nx_m = {point.x_m}\ny_m = {point.y_m}')
    for marker in (*one.markers, RigMarker(7)):
        lines.append(f"[[markers]]\nid = {marker.id}")
    path = folder / "lab.toml"
    path.write_text("\n".join(lines) + "\n")
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
    paths: dict[str, Path] = {"RIG": rig_file(tmp_path, first)}
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


FAMILY = {
    name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, IpsysError)
} | {ConvergenceError.__name__}  # fmt: skip


def test_second_calibration_that_is_invalid_leaves_no_run(ipsys: Ipsys, lab: Path) -> None:
    with Session([lab]) as session:
        first = next(session.messages(["/cameras/red/calibration"]))
    log = rewrite(lab, lambda message: message, (again(first, lambda lens: replace(lens, D=lens.D[:3])),))
    assert "found 3" in refused(ipsys, log, "replay", log, "--corners", "stock")


def raising(source: str) -> Iterator[str]:
    """The functions of a source that raise an error of the input; with their class."""

    def walk(node: ast.AST, names: tuple[str, ...]) -> Iterator[str]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                yield from walk(child, (*names, child.name))
                continue
            if isinstance(child, ast.Raise):
                error = getattr(getattr(child.exc, "func", None), "id", "")
                yield from [".".join(names)] if error in FAMILY else []
            yield from walk(child, names)

    yield from walk(ast.parse(source), ())


def imported(source: str) -> Iterator[Path]:
    """The modules of the package that a source imports."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("ipsys_log."):
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                path = PACKAGE.parent / name.replace(".", "/")
                yield from (file for file in (path.with_suffix(".py"), path / "__init__.py") if file.exists())


def functions_that_raise() -> set[str]:
    """The functions that stages can call and that raise an error of the input."""
    waiting, seen = [*(PACKAGE / "stages").rglob("*.py")], set[Path]()
    while waiting:
        path = waiting.pop()
        if path not in seen:
            seen.add(path)
            waiting += imported(path.read_text())
    found = set()
    for path in seen:
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        module = ".".join(part for part in parts if part != "__init__")
        found |= {f"{module}.{function}" for function in raising(path.read_text())}
    return found


def test_each_error_of_a_stage_has_a_case_or_a_reason() -> None:
    assert functions_that_raise() == set(RAISES)
    named = {case for cases in RAISES.values() if isinstance(cases, tuple) for case in cases}
    assert named <= set(CASES)


def test_guard_sees_a_function_that_raises() -> None:
    source = "class A:\n    def f(self):\n        if x:\n            raise FitError('a')\n"
    assert [*raising(source)] == ["A.f"]


def test_calibrations_of_every_frame_are_not_all_read(
    ipsys: Ipsys, lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some recorders write a calibration with each frame; a check must not read the whole log."""
    with Session([lab]) as session:
        first = next(iter(session.messages([session.calibrations["red"]])))
    later = tuple(replace(first, log_time_ns=first.log_time_ns + n) for n in range(1, 1001))
    log = rewrite(lab, lambda message: message, later)
    checked: list[str] = []
    monkeypatch.setattr(checks, "check_calibration", lambda lens, label: checked.append(lens.frame_id))
    ipsys("camera-frame", log)
    assert 0 < checked.count("red") <= 100
