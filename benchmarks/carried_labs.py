"""Cameras on walls from a carried body: errors of poses, clocks and intrinsics in simulated labs.

    python benchmarks/carried_labs.py                 # 16 labs
    python benchmarks/carried_labs.py --taped         # coordinates from six measured points

Three cameras in corners of a room of 5 m see a box with five markers of 12 cm, which is carried for 20 s
at 15 frames a second, out of step, with a rolling shutter. Corners have noise of 0.05 px, stamps a jitter;
intrinsics are 0.1 % and 1 px wrong before the fit.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from tests.joint.carried_wand import CLOCKS_S, CarriedWand, calibrate, carry_wand, pose_errors

Array = NDArray[np.float64]


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
    options = parser.parse_args()
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
