"""The stage *watch*: it compares the cameras with each other and with their past, and estimates new poses."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraPose, CameraPoses, Event, Markers, Message, Model
from ipsys_log.messages.channels import CAMERA_POSES, MARKERS, MODEL, RIG, RUN_EVENTS
from ipsys_log.messages.models import MOVED, PARTLY, REPAIRED
from ipsys_log.messages.stage import Plan, Stage, StageView, Step, Timed, model_read
from ipsys_log.models.table import reads_corners
from ipsys_log.statistics.model_kinds import model_kind

# States of poses that last beyond the search for a cause.
_LASTING = (MOVED, PARTLY, REPAIRED)


def repair_afterwards(view: StageView, model: Model) -> list[Timed]:
    """Return the events of a whole log, and the poses of its cameras from the instants of their motions on.

    The last estimate of each motion counts. Around the instant itself, the pose is not known.
    """
    # Late: scipy takes 1 s, and most commands need no joint model.
    from ipsys_log.calibration.joint.payload import find_motion, restore_joint
    from ipsys_log.statistics.camera_watch import WatchCameras
    from ipsys_log.statistics.deviations import STEP_NS

    watch, rows, poses = WatchCameras(model, True), list[Timed](), dict[tuple[int, str], CameraPose]()
    rigs = [view.rig] if view.rig is not None else view.payloads(RIG)[:1]
    first = [Message(RIG.topic, 0, 0, rig) for rig in rigs]
    log_ns, publish_ns = list[int](), list[int]()
    for message in chain(first, view.messages(RIG, MARKERS)):
        if isinstance(message.payload, Markers):
            log_ns.append(message.log_time_ns)
            publish_ns.append(max([message.publish_time_ns, *publish_ns[-1:]]))
        for payload in watch(message):
            if isinstance(payload, Event):
                rows.append(Timed(message.log_time_ns, payload))
            else:
                poses.update({(one.since, one.camera): one for one in payload.poses if one.state in _LASTING})
    present = restore_joint(model)
    for (since_ns, camera), pose in sorted(poses.items()):
        before = present[camera]
        present[camera] = replace(before, origin_m=pose.position_m, camera_from_world=pose.camera_from_world)
        motion = find_motion(before, present[camera])
        unknown = pose.covariance + np.outer(motion, motion)
        old_pose = before.origin_m, before.camera_from_world
        old = CameraPose(camera, MOVED, since_ns, *old_pose, unknown, 0)
        for time_ns, one in ((since_ns, old), (since_ns + 2 * STEP_NS, pose)):
            number = max(bisect_right(publish_ns, time_ns) - 1, 0)
            rows.append(Timed(log_ns[number], CameraPoses(time_ns, (one,))))
    return sorted(rows, key=lambda row: row.log_time_ns)


def _plan(view: StageView, options: Mapping[str, str]) -> Plan | str:
    model: Model = view.payloads(MODEL)[-1]
    wanted = options.get("self_calibrate", "")
    if not reads_corners(model.name):
        if wanted:
            raise IpsysError(f"--self-calibrate: {model.name} has no camera poses; use --model joint alone")
        return ""
    parameters = {"self_calibrate": "yes" if wanted == "yes" else "afterwards"} if wanted else {}
    plan = Plan(run=view.run(MODEL), parameters=parameters, reads=(RIG, MARKERS, MODEL))
    if parameters.get("self_calibrate") == "afterwards":
        return replace(plan, compute=lambda progress: repair_afterwards(view, model))
    return replace(plan, step=lambda run: _step(model, bool(parameters)))


def _step(model: Model, self_calibrate: bool) -> Step:
    from ipsys_log.statistics.camera_watch import WatchCameras

    return WatchCameras(model, self_calibrate)


STAGE = Stage(
    name="watch",
    versions={"watch": 1},
    reads=(RIG, MARKERS, MODEL),
    writes=(CAMERA_POSES, RUN_EVENTS),
    plan=_plan,
    rig_part=lambda rig, model: model_kind(model).place_part(rig),
    method=model_read,
    per_camera=False,
)
