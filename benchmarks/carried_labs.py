"""Cameras on walls from a carried body: errors of poses, clocks and intrinsics in simulated labs.

    python benchmarks/carried_labs.py                 # 16 labs
    python benchmarks/carried_labs.py --taped         # coordinates from six measured points
    python benchmarks/carried_labs.py --rendered      # one lab with images, through detect: 5 minutes

Three cameras in corners of a room of 5 m see a box with five markers of 12 cm, which is carried for 20 s
at 15 frames a second, out of step, with a rolling shutter. Corners have noise of 0.05 px, stamps a jitter;
intrinsics are 0.1 % and 1 px wrong before the fit.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ipsys_log.capture.simulation.cameras import Camera, mount_cameras, prepare_view
from ipsys_log.capture.simulation.render import encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CompressedImage, Markers, Message
from ipsys_log.stages.detect import FrameDetector
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import pose_from_rpy
from ipsys_log.vision.markers import PlacedMarker
from ipsys_log.vision.poses import make_pose, pose_facing_up, rotation
from tests.joint.carried_wand import (
    CLOCKS_S,
    START_NS,
    CarriedWand,
    Wave,
    aim,
    calibrate,
    carry_wand,
    pose_errors,
    wand_rig,
)

Array = NDArray[np.float64]


def render_wand(seed: int, duration_s: float = 15.0, rate_hz: float = 10.0) -> CarriedWand:
    """Return the detected markers of a box in rendered images of three cameras, with exact intrinsics."""
    rng, settings = np.random.default_rng(seed), LabSettings(row_time_ns=31_000, exposure_s=0.004)
    rig = replace(wand_rig(3), dictionary=settings.dictionary)
    place = Wave(rng, np.array([0.8, 0.8, 0.3]), np.array([0.11, 0.23]))
    tilt = Wave(rng, np.array([0.6, 0.6, 0.0]), np.array([0.15, 0.31]))

    def pose_at(time_s: float) -> Array:
        if time_s > duration_s:
            return make_pose(np.eye(3), np.array([2.0, 2.0, 0.0]))
        turn = rotation(np.array([0.0, 0.0, 0.5 * time_s])) @ rotation(tilt(time_s))
        return make_pose(turn, np.array([2.3, 2.3, 0.8]) + place(time_s))

    upright = pose_facing_up(0.0, 0.0, 0.0, 0.0)
    lens = mount_cameras(settings)[0].lens
    markers, cameras, lenses = {}, {}, {}
    corners_m = np.array([[0.6, 0.6, 2.6], [4.0, 0.8, 2.5], [2.2, 4.1, 2.7]])
    for number, (origin_m, clock_s) in enumerate(zip(corners_m, CLOCKS_S, strict=False)):
        name = f"c{number}"
        cameras[name] = aim(origin_m, np.array([2.3, 2.3, 0.4]))
        camera = Camera(name, replace(lens, frame_id=name), cameras[name])
        view, detect, lenses[name] = prepare_view(camera, settings), FrameDetector(), camera.lens
        for payload in (rig, camera.lens):
            list(detect(Message("/first", 0, 0, payload, name)))
        frames = []
        for frame in range(int((duration_s + 3) * rate_hz)):
            time_s = frame / rate_hz + 0.031 * number
            prints = []
            for marker in rig.markers[:5]:
                on_body = pose_from_rpy(marker.xyz_m, marker.rpy_rad)
                facing = pose_at(time_s) @ on_body
                if facing[:3, 2] @ (origin_m - facing[:3, 3]) < 0.15:
                    continue
                print_pose = on_body @ upright
                prints.append(
                    lambda later_s, marker=marker, print_pose=print_pose, time_s=time_s: PlacedMarker(
                        marker.id, 0.12, pose_at(time_s + later_s) @ print_pose
                    )
                )
            image = encode_jpeg(render(view, prints, settings, rng), settings)
            stamp_ns = START_NS + round((time_s - clock_s) * NS_PER_S)
            message = Message(
                "/image", stamp_ns, stamp_ns, CompressedImage(stamp_ns, name, image, "jpeg"), name
            )
            frames += [one for one in detect(message) if isinstance(one, Markers)]
        markers[name] = frames
    # The body lies 2 m from the corner of the room.
    moved = {
        name: camera @ make_pose(np.eye(3), np.array([2.0, 2.0, 0.0])) for name, camera in cameras.items()
    }
    return CarriedWand(rig, lenses, markers, [], moved, lenses)


def measure(wand: CarriedWand) -> dict[str, Array]:
    """Return errors of each camera: mm, degrees, NEES, and standard deviations of clocks and intrinsics."""
    fit, _, lab = calibrate(wand)
    errors, scores = pose_errors(lab, wand)
    sigmas, values = np.sqrt(lab.covariance.diagonal()), lab.state.values
    blocks = lab.problem.layout.cameras
    clocks = [
        (values[block.edge + 1] - true_s) / sigmas[block.edge + 1]
        for block, true_s in zip(blocks[1:], CLOCKS_S[1:], strict=False)
    ]
    lenses = []
    for block, true in zip(blocks, wand.true_lenses.values(), strict=True):
        own = slice(block.lens.start, block.lens.start + 4)
        K = np.r_[true.K[0, 0], true.K[1, 1], true.K[:2, 2]]
        lenses.append((values[own] - K) / sigmas[own])
    return {
        "position mm": 1000 * np.linalg.norm(errors[:, 3:], axis=1),
        "rotation deg": np.degrees(np.linalg.norm(errors[:, :3], axis=1)),
        "NEES": scores,
        "clock in sigmas": np.array(clocks),
        "intrinsics in sigmas": np.concatenate(lenses),
        "jitter ms": np.array([1000 * fit.settings.stamp_jitter_s]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--labs", type=int, default=16)
    parser.add_argument("--jitter-ms", type=float, default=3.0)
    parser.add_argument("--taped", action="store_true", help="coordinates from measured points")
    parser.add_argument("--rendered", action="store_true", help="one lab with images")
    options = parser.parse_args()
    if options.rendered:
        with threadpool_limits(1):
            for name, own in measure(render_wand(600)).items():
                print(f"{name:<22}", np.round(own, 3).tolist())
        return
    rows: dict[str, list[Array]] = {}
    with threadpool_limits(1):
        for seed in range(600, 600 + options.labs):
            wand = carry_wand(seed, count=3, jitter_s=options.jitter_ms / 1000, taped=options.taped)
            for name, own in measure(wand).items():
                rows.setdefault(name, []).append(own)
    print(f"{options.labs} labs, {'measured points' if options.taped else 'body at rest'}")
    print(f"{'':<22}{'median':>9}{'p95':>9}{'RMS':>9}{'mean':>9}")
    for name, parts in rows.items():
        all_rows = np.concatenate(parts)
        sizes = np.abs(all_rows)
        figures = np.median(sizes), np.percentile(sizes, 95), np.sqrt(np.mean(sizes**2)), all_rows.mean()
        print(f"{name:<22}" + "".join(f"{figure:>9.3f}" for figure in figures))


if __name__ == "__main__":
    main()
