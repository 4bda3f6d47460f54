"""The watch over the cameras: it names what has changed, and repairs the poses of moved cameras."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import move_camera, restore_joint
from ipsys_log.messages import Array, CameraPose, CameraPoses, Event, Markers, Message, Model, Rig
from ipsys_log.messages.events import (
    CAMERA_DRIFTED,
    CAMERA_MOVED,
    CAMERA_REPAIRED,
    CLOCK_JUMPED,
    MARKER_MOVED,
)
from ipsys_log.messages.models import CLEARED, MOVED, PARTLY, REPAIRED, SUSPECTED
from ipsys_log.statistics.camera_changes import (
    TESTED_STEPS,
    Cause,
    Evidence,
    Explanation,
    Repair,
    StartingClocks,
    ViewedFloor,
    find_causes,
    gather_evidence,
    is_change,
    likely_causes,
)
from ipsys_log.statistics.deviations import STEP_NS, Deviation, DeviationStep, DeviationStream
from ipsys_log.statistics.usual_deviations import UsualDeviations
from ipsys_log.units import MM_PER_M, NS_PER_S

# A change whose cause stays unclear is examined for so long.
_LONGEST_UNCLEAR_NS = 60 * NS_PER_S
# Ages of a repair at which its estimate comes into use, and the largest standard deviation for that, as the
# mean over the floor. A less certain estimate is used in part if its standard deviation is below this share
# of the error of the old positions; from the last age on, any.
_ADOPTIONS_NS = tuple(age_s * NS_PER_S for age_s in (3, 6, 10, 20, 60))
_CERTAIN_M, _BETTER = 4e-4, 0.2
# A repair with a larger mean square of its residuals begins again at the first two ages, for the slopes of a
# large motion are wrong; later it is refused. Motions have 0.7 at most, other focal lengths reach 1 to 60.
_MOST_MISFIT = 1.5
_FEWEST_DEVIATIONS = 20
# Variances of a motion that no number of deviations reduces: warmth and light, in rad^2 and m^2.
_LEAST_COVARIANCE = np.diag(np.repeat([1e-5, 3e-5], 3) ** 2)
_NEVER_NS = 2**62
# Share of level markers in a camera whose pose is right; the pose of another one is unknown to this extent.
_MANY_LEVEL, _FAR_RAD, _FAR_M = 0.7, 0.2, 0.2
# A carried marker is left out for so long; the same explanation within the second time is no new event.
_IGNORED_NS, _REPEATED_NS = 10 * NS_PER_S, 60 * NS_PER_S
# Slow motions are examined at multiples of this log time. They are reported from this mean error on, with so
# many standard deviations: an image that moves by 0.2 px in a warm camera shifts positions by 0.9 mm.
_DRIFT_CHECK_NS, _LEAST_DRIFT_M, _SURE_SIGMAS = 60 * NS_PER_S, 0.0015, 5.0
# Causes that are tested without a pause.
_AT_ONCE = 4
# After so long without a frame, another recording begins. Larger offsets of its clocks are estimated again.
_RESTART_NS, _LINEAR_S = 10 * NS_PER_S, 0.005
# Smaller jumps of a clock are corrected within this stage only. A larger one displaces robots of this speed.
_LEAST_JUMP_MS, _SPEED_M_S = 3.0, 0.5


@dataclass(slots=True, eq=False)
class _Examined:
    """A step with the evidence in its deviations."""

    step: DeviationStep
    evidence: Mapping[Cause, Evidence]


@dataclass(slots=True, eq=False)
class _Moved:
    """A camera that has moved: since when, when it was named, and its repair.

    ``shift_m`` is the mean error of its old positions, ``next_ns`` the age at which the estimate is used
    next, and ``state`` that of its pose in use.
    """

    since_ns: int
    named_ns: int
    shift_m: float
    repair: Repair
    next_ns: int = _ADOPTIONS_NS[0]
    state: str = MOVED


@dataclass(slots=True, eq=False)
class _Unclear:
    """A change whose cause is not clear: since when, when it was noticed, and the likely causes so far."""

    since_ns: int
    noticed_ns: int
    likely: list[Cause] = field(default_factory=list)


class WatchCameras:
    """The step from markers to the poses of moved cameras, and events that name what has changed.

    All times are log times, so that a replay gives the same results.

    Parameters
    ----------
    model : a joint model.
    self_calibrate : whether new poses are estimated and used.
    """

    def __init__(self, model: Model, self_calibrate: bool) -> None:
        self._stream, self._usual = DeviationStream(restore_joint(model)), UsualDeviations()
        self._self_calibrate = self_calibrate
        self._floors: dict[str, ViewedFloor] = {}
        self._steps: deque[_Examined] = deque()
        self._done_ns = 0
        self._unclear: _Unclear | None = None
        self._suspected: list[str] = []
        self._moved: dict[str, _Moved] = {}
        self._adopted: dict[str, Array] = {}
        self._named_ns: dict[str, int] = {}
        self._level: set[str] = set()
        # The clocks of the recording, until they are known; their offsets so far; log time of its last frame.
        self._clocks: StartingClocks | None = None
        self._late_s: dict[str, float] = {}
        self._pairs: list[tuple[int, Deviation]] = []
        self._last_ns = -_RESTART_NS
        # The rest of the work on the last step.
        self._work: Iterator[Any] = iter(())

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            for marker_id in self._stream.use_rig(message.payload):
                self._usual.forget(marker_id)
        elif isinstance(message.payload, Markers):
            self._see_floor(str(message.camera), message.payload)
            if message.log_time_ns > self._last_ns + _RESTART_NS:
                self._restart()
            self._last_ns = message.log_time_ns
            if self._stream.collect(message):
                yield from (payload for payload in self._work if payload is not None)
                self._work = self._take_step()
            for payload in self._work:
                if payload is None:
                    break
                yield payload

    def _see_floor(self, camera: str, frame: Markers) -> None:
        model, rig = self._stream.cameras.get(camera), self._stream.rig
        if model is not None and rig is not None and camera not in self._floors:
            self._floors[camera] = ViewedFloor.of_camera(model, frame.width, frame.height, rig.floor)

    def _take_step(self) -> Iterator[Any]:
        """Test the deviations of half a second, and improve the repairs.

        None in the result are pauses: the next frame goes on from there, so that no frame waits for all.
        """
        parts = self._stream.finish_step()
        while (step := next(parts)) is None:
            yield None
        yield None
        time_ns, self._done_ns = step.time_ns, step.last_ns
        if self._clocks is not None:
            self._pairs += [(time_ns, one) for one in step.deviations if one.by_clock is not None]
            yield from self._start_clocks(self._clocks, step)
            step.deviations = [one for one in step.deviations if one.by_clock is None]
        for camera in sorted(self._stream.fits):
            yield from self._check_level(camera, time_ns)
        for camera, moved in self._moved.items():
            moved.repair.add(self._usual, step.deviations, camera, time_ns)
        unused = [camera for camera, moved in self._moved.items() if moved.state != REPAIRED]
        yield None
        self._steps.append(_Examined(step, gather_evidence(self._usual, step.deviations, time_ns, unused)))
        yield None
        yield from self._examine(time_ns)
        for camera in list(self._moved):
            yield from self._adopt(camera, time_ns)
        if time_ns % _DRIFT_CHECK_NS == 0:
            yield from self._check_drift()

    def _restart(self) -> None:
        """Begin another recording, whose clocks have other offsets."""
        self._clocks, self._late_s, self._pairs = StartingClocks([*self._stream.cameras]), {}, []
        self._stream.forget_clocks()
        while self._unclear is None and self._steps:
            self._learn(self._steps.popleft().step)

    def _start_clocks(self, clocks: StartingClocks, step: DeviationStep) -> Iterator[Any]:
        """Estimate the clock offsets of a recording from its first seconds; correct and report them."""
        clocks.add(self._usual, step.deviations, step.time_ns)
        offsets_s = clocks.offsets_s()
        if offsets_s is None:
            return
        for camera, offset_s in offsets_s.items():
            if offset_s:
                self._late_s[camera] = self._late_s.get(camera, 0.0) + offset_s
                self._stream.delay(camera, -round(offset_s * NS_PER_S))
        if max(map(abs, offsets_s.values())) > _LINEAR_S:
            self._clocks, self._pairs = StartingClocks([*self._stream.cameras]), []
            return
        self._clocks = None
        self._learn_pairs(offsets_s)
        for camera, late_s in self._late_s.items():
            if abs(late_s) * 1e3 > _LEAST_JUMP_MS:
                text = (
                    f"the clock of camera {camera} differs by {late_s * 1e3:.0f} ms from the calibration: "
                    f"its positions of a robot at {_SPEED_M_S} m/s are wrong by "
                    f"{abs(late_s) * _SPEED_M_S * MM_PER_M:.0f} mm"
                )
                yield Event(self._done_ns, CLOCK_JUMPED, text, camera, start=self._done_ns)

    def _learn_pairs(self, late_s: Mapping[str, float]) -> None:
        """Learn the deviations of pairs from the time when the clocks were not known."""
        steps: dict[int, list[Deviation]] = defaultdict(list)
        for time_ns, one in self._pairs:
            assert one.by_clock is not None
            first_s, second_s = (late_s.get(camera, 0.0) for camera in one.cameras)
            steps[time_ns].append(replace(one, value=one.value - one.by_clock[:, 0] * (second_s - first_s)))
        self._pairs = []
        for time_ns, deviations in steps.items():
            self._learn(DeviationStep(time_ns, time_ns, deviations))

    def poses(self) -> dict[str, tuple[JointModel, Array]]:
        """Return the pose of each camera by the last sightings, and the covariance (6, 6) of its motion."""
        motions = self._usual.slow_motions(sorted(self._stream.cameras))
        found = {}
        for camera, model in self._stream.cameras.items():
            moved = self._moved.get(camera)
            slow = motions[camera] if moved is None else (moved.repair.motion, moved.repair.covariance)
            found[camera] = move_camera(model, slow[0]), slow[1] + self._adopted.get(camera, 0.0)
        return found

    def floor_of(self, camera: str) -> ViewedFloor | None:
        """Return the floor that a camera sees; None before its first frame."""
        return self._floors.get(camera)

    def _check_drift(self) -> Iterator[Any]:
        """Report cameras that have moved slowly since the start, or since their last repair."""
        motions = self._usual.slow_motions(sorted(self._stream.cameras))
        for camera, (motion, covariance) in motions.items():
            floor = self._floors.get(camera)
            if floor is None or camera in self._moved:
                continue
            shift_m, sigma_m = floor.mean_shift(motion), floor.mean_sigma(covariance)
            if shift_m > max(_LEAST_DRIFT_M, _SURE_SIGMAS * sigma_m):
                text = f"camera {camera} has drifted: its mean error grew by {shift_m * MM_PER_M:.1f} mm"
                yield Event(self._done_ns, CAMERA_DRIFTED, text, camera)
                self._usual.forget_camera(camera)
                if self._self_calibrate:
                    self._stream.move(camera, motion)
                    # All cameras share the motion of one, and means lag behind it: as much again may be left.
                    unknown = covariance + np.outer(motion, motion)
                    self._adopted[camera] = unknown + self._adopted.get(camera, 0.0)
                    pose = self._pose(camera, REPAIRED, self._done_ns, self._adopted[camera])
                    yield CameraPoses(self._done_ns, (pose,))

    def _check_level(self, camera: str, time_ns: int) -> Iterator[Any]:
        """Report a camera in which no marker is level any more: it was turned far, or exchanged."""
        counts: dict[int, Array] = defaultdict(lambda: np.zeros(2))
        for step in self._stream.fits[camera]:
            for marker_id, one in step.items():
                counts[marker_id] += one
        level, markers = sum(counts.values(), np.zeros(2)).tolist()
        if markers < _FEWEST_DEVIATIONS or camera in self._moved:
            return
        if level > _MANY_LEVEL * markers:
            self._level.add(camera)
        elif level < (1 - _MANY_LEVEL) * markers and camera in self._level:
            odd = [one for one, all_ in counts.values() if one < (1 - _MANY_LEVEL) * all_]
            if len(odd) < min(2, len(self._stream.robots())):
                return  # one robot of several: its marker is not level, or its corners are wrong
            covariance = np.diag(np.repeat([_FAR_RAD, _FAR_M], 3) ** 2)
            pose = self._pose(camera, MOVED, self._done_ns, covariance)
            yield CameraPoses(self._done_ns, (pose,))
            text = (
                f"camera {camera} was turned far, zoomed, or exchanged: no marker is level at its height; "
                "calibrate the lab again"
            )
            yield Event(self._done_ns, CAMERA_MOVED, text, camera, start=self._done_ns)
            self._moved[camera] = _Moved(self._done_ns, time_ns, _FAR_M, Repair(_FAR_RAD), _NEVER_NS)

    def _examine(self, time_ns: int) -> Iterator[Any]:
        """Test the last steps for a change; report it, and its cause when that is clear."""
        while self._unclear is None and len(self._steps) > TESTED_STEPS:
            self._learn(self._steps.popleft().step)
            yield None
        explanations = []
        for explanation in find_causes([one.evidence for one in self._steps]):
            explanations.append(explanation)
            if len(explanations) % _AT_ONCE == 0:
                yield None
        likely = likely_causes(explanations) if explanations else []
        if not likely or (self._unclear is None and not is_change(likely[0], self._floors)):
            return
        if self._unclear is None:
            for _ in range(likely[0].first):
                self._learn(self._steps.popleft().step)
            self._unclear = _Unclear(self._steps[0].step.last_ns - STEP_NS, time_ns)
            yield from self._suspect(likely)
            # This step is partly from before the change.
            self._steps[0].evidence = {}
            return
        # Two successive steps must agree.
        before, self._unclear.likely = self._unclear.likely, [one.cause for one in likely]
        is_clear = len(likely) == 1 and before == self._unclear.likely and is_change(likely[0], self._floors)
        if is_clear:
            since_ns, self._unclear = self._unclear.since_ns, None
            steps, self._steps = [one.step for one in self._steps], deque()
            yield from self._name(likely[0], since_ns, time_ns)
            name = likely[0].cause.name
            for step in steps:
                kept = [one for one in step.deviations if name not in (str(one.marker_id), *one.cameras)]
                self._learn(DeviationStep(step.time_ns, step.last_ns, kept))
        elif time_ns - self._unclear.noticed_ns > _LONGEST_UNCLEAR_NS:
            yield from self._give_up()

    def _give_up(self) -> Iterator[Any]:
        """End the search for a cause; the cameras stay uncertain if the last steps show the change, too."""
        assert self._unclear is not None
        since_ns, self._unclear = self._unclear.since_ns, None
        self._steps = deque(list(self._steps)[-TESTED_STEPS:])
        recent = likely_causes(list(find_causes([one.evidence for one in self._steps])))
        if not (recent and is_change(recent[0], self._floors)):
            suspected, self._suspected = self._suspected, []
            if suspected:
                yield CameraPoses(self._done_ns, tuple(self._clear(suspected, since_ns)))

    def _learn(self, step: DeviationStep) -> None:
        known = [one for one in step.deviations if not set(one.cameras) & set(self._moved)]
        self._usual.learn(known, step.time_ns)

    def _suspect(self, likely: Sequence[Explanation]) -> Iterator[Any]:
        """Report that a camera may have moved; positions of all possible ones become uncertain."""
        assert self._unclear is not None
        since_ns = self._unclear.since_ns
        poses = [self._old_pose(one, SUSPECTED, since_ns) for one in likely if one.cause.kind == "camera"]
        if poses:
            self._suspected = [pose.camera for pose in poses]
            yield CameraPoses(self._done_ns, tuple(poses))
            names = " or ".join(dict.fromkeys(_describe(one.cause) for one in likely))
            text = f"a change of {names}; the next seconds show which"
            camera = poses[0].camera if len(likely) == 1 else None
            yield Event(self._done_ns, CAMERA_MOVED, text, camera, start=since_ns)

    def _old_pose(self, explanation: Explanation, state: str, since_ns: int) -> CameraPose:
        """Return the present pose of a camera, whose covariance contains the motion that was found."""
        covariance = explanation.covariance + np.outer(explanation.estimate, explanation.estimate)
        return self._pose(explanation.cause.name, state, since_ns, covariance)

    def _pose(
        self, camera: str, state: str, since_ns: int, covariance: Array, deviations: int = 0
    ) -> CameraPose:
        """Return the present pose of a camera as a payload."""
        model = self._stream.cameras[camera]
        turn, origin_m = model.camera_from_world, model.origin_m
        return CameraPose(camera, state, since_ns, origin_m, turn, covariance, deviations)

    def _clear(self, cameras: Sequence[str], since_ns: int) -> list[CameraPose]:
        """Return the poses of cameras that have not moved, with the covariances of their last repairs."""
        none = np.zeros((6, 6))
        return [self._pose(one, CLEARED, since_ns, self._adopted.get(one, none)) for one in cameras]

    def _name(self, explanation: Explanation, since_ns: int, time_ns: int) -> Iterator[Any]:
        """Report the cause of a change."""
        kind, name = explanation.cause
        poses = self._clear([one for one in self._suspected if (kind, name) != ("camera", one)], since_ns)
        self._suspected = []
        if kind == "camera":
            # Its deviations are in the repairs of others: certain ones end, the rest begins again.
            self._moved = {one: moved for one, moved in self._moved.items() if moved.state != REPAIRED}
            for moved in self._moved.values():
                moved.repair = Repair(moved.repair.turn_rad)
            poses.append(self._old_pose(explanation, MOVED, since_ns))
            shift_m = self._floors[name].mean_shift(explanation.estimate)
            advice = "its new pose is being estimated" if self._self_calibrate else "use --self-calibrate"
            text = f"camera {name} has moved: its mean error is {shift_m * MM_PER_M:.1f} mm; {advice}"
            yield Event(self._done_ns, CAMERA_MOVED, text, name, start=since_ns)
            self._stream.move(name, explanation.estimate)
            repair = Repair(float(np.linalg.norm(explanation.estimate[:3])))
            self._moved[name] = _Moved(since_ns, time_ns, shift_m, repair)
        elif kind == "clock":
            jump_ms = float(explanation.estimate[0]) * 1e3
            text = f"the clock of camera {name} jumped by {jump_ms:.0f} ms; start this camera again"
            if abs(jump_ms) > _LEAST_JUMP_MS and time_ns - self._named_ns.get(name, 0) > _REPEATED_NS:
                covariance = np.diag(np.repeat([0.001, _SPEED_M_S * jump_ms * 1e-3], 3) ** 2)
                poses.append(self._pose(name, MOVED, since_ns, covariance))
                yield Event(self._done_ns, CLOCK_JUMPED, text, name, start=since_ns)
            self._named_ns[name] = time_ns
            self._stream.delay(name, -round(float(explanation.estimate[0]) * NS_PER_S))
        elif kind == "carried":
            if time_ns - self._named_ns.get(name, 0) > _REPEATED_NS:
                text = f"marker {name} is not level at its height: it is carried, loose, or of another height"
                yield Event(self._done_ns, MARKER_MOVED, text, marker_id=int(name), start=since_ns)
            self._named_ns[name] = time_ns
            self._stream.ignore(int(name), time_ns + _IGNORED_NS)
            self._usual.forget(int(name))
        else:
            size_mm = float(np.linalg.norm(explanation.estimate[:3])) * MM_PER_M
            what = "has another height on its robot" if kind == "robot" else "has moved"
            advice = "measure it again, and correct lab.toml"
            text = f"{_describe(explanation.cause)} {what}, by {size_mm:.1f} mm; {advice}"
            yield Event(self._done_ns, MARKER_MOVED, text, marker_id=int(name), start=since_ns)
            self._stream.ignore(int(name), time_ns)
            self._usual.forget(int(name))
        if poses:
            yield CameraPoses(self._done_ns, tuple(poses))

    def _adopt(self, camera: str, time_ns: int) -> Iterator[Any]:
        """Use the estimate of a repair once it is certain; end the repair with the last estimate."""
        moved, age_ns = self._moved[camera], time_ns - self._moved[camera].named_ns
        repair = moved.repair
        if not self._self_calibrate or age_ns < moved.next_ns or repair.count < _FEWEST_DEVIATIONS:
            return
        moved.next_ns = next((one for one in _ADOPTIONS_NS if one > age_ns), age_ns + _ADOPTIONS_NS[-1])
        is_last = age_ns >= _ADOPTIONS_NS[-1]
        if repair.misfit > _MOST_MISFIT:
            self._stream.move(camera, repair.motion)
            moved.repair = Repair(repair.turn_rad)
            if age_ns >= _ADOPTIONS_NS[2] or moved.state != MOVED:
                yield from self._refuse(camera, moved)
            return
        covariance = repair.covariance * max(repair.misfit, 1.0) + _LEAST_COVARIANCE
        sigma_m = self._floors[camera].mean_sigma(covariance)
        is_certain = sigma_m < _CERTAIN_M
        if not (is_certain or is_last or sigma_m < _BETTER * moved.shift_m):
            return
        self._stream.move(camera, repair.motion)
        repair.rebase()
        self._adopted[camera] = covariance
        state = REPAIRED if is_certain else PARTLY
        pose = self._pose(camera, state, moved.since_ns, covariance, repair.count)
        yield CameraPoses(self._done_ns, (pose,))
        if is_last or state != moved.state:
            known = f"known to {max(sigma_m * MM_PER_M, 0.1):.1f} mm"
            if not is_certain:
                known += " in part; drive through the overlap, or add a reference marker"
            text = f"camera {camera}: positions use its new pose, {known}"
            yield Event(self._done_ns, CAMERA_REPAIRED, text, camera, start=moved.since_ns)
        moved.state = state
        if is_last and is_certain:
            del self._moved[camera]

    def _refuse(self, camera: str, moved: _Moved) -> Iterator[Any]:
        """End a repair without a new pose."""
        covariance = np.diag(np.repeat([moved.shift_m / 4, moved.shift_m / 2], 3) ** 2)
        yield CameraPoses(self._done_ns, (self._pose(camera, MOVED, moved.since_ns, covariance),))
        moved.state, moved.next_ns = MOVED, _NEVER_NS
        text = (
            f"camera {camera}: no motion explains its deviations: its lens was changed, or it is another "
            "camera; calibrate the lab again"
        )
        yield Event(self._done_ns, CAMERA_MOVED, text, camera, start=moved.since_ns)


def _describe(cause: Cause) -> str:
    others = {"robot": "marker", "carried": "marker", "reference": "reference marker"}
    return f"{others.get(cause.kind, cause.kind)} {cause.name}".replace("clock", "the clock of camera")
