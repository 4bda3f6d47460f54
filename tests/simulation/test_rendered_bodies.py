"""A free body in rendered images with a rolling shutter: detection and its poses against the ground truth."""

import numpy as np
import pytest

from ipsys_log.calibration.joint.floor_field import make_floor_field
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.observations import lens_model_of
from ipsys_log.capture.simulation.cameras import Camera, mount_cameras, prepare_view
from ipsys_log.capture.simulation.render import encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import (
    Array,
    CompressedImage,
    Markers,
    Message,
    Position,
    Rig,
    RigBody,
    RigCamera,
    RigMarker,
)
from ipsys_log.models.body_positions import BodyLocator
from ipsys_log.stages.detect import FrameDetector
from ipsys_log.vision.bodies import pose_from_rpy
from ipsys_log.vision.markers import MovingMarker, PlacedMarker
from ipsys_log.vision.poses import invert_pose, make_pose, pose_facing_up, rotation, rotation_vector

LAB = LabSettings(row_time_ns=31_000, exposure_s=0.004)
# Tilted markers beside a level one.
MARKERS = (
    RigMarker(0, 0.1, "drone"),
    RigMarker(1, 0.1, "drone", xyz_m=(0.16, 0.05, -0.02), rpy_rad=(0.2, 0.1, 0.6)),
    RigMarker(2, 0.1, "drone", xyz_m=(-0.02, 0.17, -0.01), rpy_rad=(-0.15, 0.2, -0.4)),
    RigMarker(3, 0.1, "drone", xyz_m=(-0.17, 0.02, -0.03), rpy_rad=(0.1, -0.25, 2.0)),
)
FRAMES, RATE_HZ = 14, 30.0
# Detection knows the motion of a marker after three frames.
FIRST = 3


def exact_model(camera: Camera) -> JointModel:
    """Return the true camera, without errors."""
    lens, flat = camera.lens, make_floor_field(np.zeros(2), np.ones(2), 0.0, 1.0)
    intrinsics = np.array([lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2], *lens.D])
    turn, none = camera.camera_from_world[:3, :3], np.zeros((len(intrinsics) + 10, 1))
    offsets = 0.0, 0.0, 0.0, 1.0
    floor = flat, np.zeros(flat.count)
    return JointModel(
        lens_model_of(lens),
        turn,
        camera.origin_m,
        intrinsics,
        *offsets,
        *floor,
        none,
        np.zeros((flat.count, 1)),
        0.01,
    )


def pose_at(camera: Camera, time_s: float) -> Array:
    """Return the pose of a body that rises, turns and tilts below a camera, with 0.7 m/s."""
    tilts = 0.4 * np.sin([3 * time_s, 2 * time_s + 1])
    turn = rotation(np.array([0.0, 0.0, 0.8 * time_s])) @ rotation(np.array([*tilts, 0.0]))
    way_m = np.array([0.5 * time_s - 0.4, 0.3 * time_s - 0.3, 0.5 + 0.2 * np.sin(2 * time_s)])
    return make_pose(turn, camera.origin_m * [1.0, 1.0, 0.0] + way_m)


def moving(camera: Camera, marker: RigMarker, stamp_s: float) -> MovingMarker:
    # Markers of the renderer have y to the top of the print.
    upright = invert_pose(pose_facing_up(0.0, 0.0, 0.0, 0.0))
    body_from_marker = pose_from_rpy(marker.xyz_m, marker.rpy_rad) @ invert_pose(upright)
    return lambda time_s: PlacedMarker(marker.id, 0.1, pose_at(camera, stamp_s + time_s) @ body_from_marker)


@pytest.mark.parametrize(("count", "most_m", "most_deg"), [(1, 6e-4, 0.12), (2, 4e-4, 0.1), (4, 1e-4, 0.03)])
def test_poses_of_a_rendered_body_have_the_errors_that_they_state(
    count: int, most_m: float, most_deg: float
) -> None:
    markers = MARKERS[:count]
    camera = mount_cameras(LAB)[0]
    rig = Rig(
        "lab",
        LAB.dictionary,
        0.2,
        markers,
        (RigCamera(camera.name, row_time_ns=LAB.row_time_ns),),
        bodies=(RigBody("drone", level=False),),
    )
    view, rng, detect = prepare_view(camera, LAB), np.random.default_rng(0), FrameDetector()
    locator = BodyLocator({camera.name: exact_model(camera)})
    locator.use_rig(rig)
    for payload in (rig, camera.lens):
        assert not list(detect(Message("/first", 0, 0, payload, camera.name)))
    errors, squares, single_m = [], [], []
    for number in range(FRAMES):
        stamp_s = number / RATE_HZ
        stamp_ns = round(stamp_s * 1e9)
        image = render(view, [moving(camera, marker, stamp_s) for marker in markers], LAB, rng)
        frame = CompressedImage(stamp_ns, camera.name, encode_jpeg(image, LAB), "jpeg")
        (seen,) = (
            one
            for one in detect(Message("/image", stamp_ns + 1, stamp_ns, frame, camera.name))
            if isinstance(one, Markers)
        )
        exposed_ns = [stamp_ns + (marker.time_offset_ns or 0) for marker in seen.markers]
        (position,) = locator.locate(camera.name, stamp_ns, seen.markers, exposed_ns)
        assert isinstance(position, Position)
        assert position.rotation_rad is not None
        at_s = (stamp_ns + (position.time_offset_ns or 0)) / 1e9
        before, true, after = (pose_at(camera, at_s + step_s) for step_s in (-1e-3, 0.0, 1e-3))
        turned_rad = rotation_vector(after[:3, :3] @ before[:3, :3].T)
        twist = np.concatenate([after[:3, 3] - before[:3, 3], turned_rad]) / 2e-3
        assert position.to_still is not None
        assert position.still_by_motion is not None
        assert position.still_noise is not None
        single_m.append(np.array([position.x_m, position.y_m, position.z_m]) - true[:3, 3])
        place_m = single_m[-1] + true[:3, 3] + position.to_still[:3]
        turn = rotation(position.to_still[3:]) @ rotation(position.rotation_rad)
        wrong_rad = rotation_vector(turn @ true[:3, :3].T)
        wrong = np.concatenate([place_m - true[:3, 3], wrong_rad]) - position.still_by_motion @ twist
        errors.append(wrong)
        squares.append(wrong @ np.linalg.solve(position.still_noise, wrong) / 6)
    # The pose of one frame does not know the velocity.
    assert np.linalg.norm(single_m[FIRST:], axis=1).mean() < 2e-3
    lengths_m = np.linalg.norm(np.array(errors)[FIRST:, :3], axis=1)
    angles_rad = np.linalg.norm(np.array(errors)[FIRST:, 3:], axis=1)
    assert lengths_m.mean() < most_m
    assert np.degrees(angles_rad.mean()) < most_deg
    assert 0.3 < np.mean(squares[FIRST:]) < 1.5
