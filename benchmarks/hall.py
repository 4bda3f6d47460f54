"""Joint calibration of simulated halls from one drive and eight taped points: error, time and memory.

    python benchmarks/hall.py                      # 3, 6, 12 and 24 cameras
    python benchmarks/hall.py --hall-labs 3        # with three seeds
    python benchmarks/hall.py --hall-floor-mm 1.5  # an uneven floor

Each hall has one robot for two cameras; all drive at the same time. Clocks of the cameras have offsets of up
to 25 ms, and intrinsics have the errors of a chessboard calibration. There are no images: markers have the
noise of detect. The error is that of noise-free markers on a grid over the whole floor, against the ground
truth. Times are processor times of one thread, each hall in its own process. The exponent is that of the
sightings in the time: 1 means that twice the sightings take twice the time.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace

import numpy as np
from geometric_labs import Scene, joint_locator, make_session, nodes_of, observe_session
from results import Report, command
from rounds import Row
from threadpoolctl import threadpool_limits

from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.calibration.joint.start import PlacedCamera, place_cameras
from ipsys_log.capture.simulation.settings import hall_settings
from ipsys_log.log.codec import encode
from ipsys_log.statistics.expected_error import mean_lengths
from tests.geometric.floor_error import (
    KnownSightings,
    SightingErrors,
    compute_errors,
    region_shares,
    summarize,
)
from tests.geometric.lab import GeometricLab, GeometricSettings

__all__ = ["measure"]

# No other part of the project uses these seeds.
_FIRST_SEED = 3000
_GRIDS = ((3, 1), (3, 2), (4, 3), (6, 4))
_POINTS, _RATE_HZ, _CLOCK_S = 8, 10.0, 0.025
# The nodes are 0.1 m apart; a prime number takes some of each row.
_EVERY_NODE = 11
_MM, _KB_PER_MB, _BYTES_PER_MB = 1000.0, 1024, 1_000_000
_MOST_EXPONENT = 1.2


@dataclass(frozen=True, slots=True)
class Figures:
    """The figures of one hall.

    ``message_mb`` is the size of the message of the model. ``unmeasured`` cameras see no taped point.
    ``start_s`` and ``fit_s`` are processor times of the rough poses, and of the whole calibration.
    ``start_mm`` is the largest error of a rough origin. The other errors are those over the floor;
    ``aligned_mm`` is the mean after the best rigid alignment. ``stated_mm`` is the mean expected error by
    the covariance, and ``nees`` the normalised squared error per degree of freedom. ``worst_mm`` is the
    largest error of a node, ``worst_stated_mm`` the expected error there.
    """

    cameras: int
    sightings: int
    unmeasured: int
    start_s: float
    fit_s: float
    steps: int
    memory_mb: float
    message_mb: float
    start_mm: float
    mean_mm: float
    p95_mm: float
    aligned_mm: float
    stated_mm: float
    nees: float
    worst_mm: float
    worst_stated_mm: float


def measure(options: argparse.Namespace) -> Report:
    """Calibrate halls of every size."""
    grids = ((2, 1), (3, 1)) if options.smoke else _GRIDS
    drive_s = 10.0 if options.smoke else options.hall_drive_s
    seeds = range(_FIRST_SEED, _FIRST_SEED + (1 if options.smoke else options.hall_labs))
    report, halls = Report("hall"), []
    for grid in grids:
        work = [(grid, seed, drive_s, options.hall_floor_mm) for seed in seeds]
        halls.append([_in_own_process(*one) for one in work])
    for own in halls:
        count = own[0].cameras
        report.rows.append(Row(f"mean error, {count} cameras", tuple(one.mean_mm for one in own), "mm"))
        report.details[f"{count} cameras"] = [asdict(one) for one in own]
    # One exponent for each seed, over the halls of all sizes.
    by_seed = list(zip(*halls, strict=True))
    report.tables.append(_table(by_seed[0]))
    if not options.smoke:
        limit = ("<=", _MOST_EXPONENT)
        whole = tuple(_exponent(own, [one.fit_s for one in own]) for own in by_seed)
        one_step = tuple(_exponent(own, [one.fit_s / one.steps for one in own]) for own in by_seed)
        report.rows.append(Row("exponent of the time", whole, wanted=limit))
        report.rows.append(Row("exponent of the time of a step", one_step, wanted=limit))
    return report


def _exponent(halls: Sequence[Figures], times_s: Sequence[float]) -> float:
    """Return the slope of the best line through the logarithms of sightings and times."""
    return float(np.polyfit(np.log([one.sightings for one in halls]), np.log(times_s), 1)[0])


def _table(halls: Sequence[Figures]) -> str:
    lines = ["cameras sightings no point steps  start   fit   MB model start mm mean mm  p95"]
    for one in halls:
        times = f"{one.start_s:>5.2f} s{one.fit_s:>4.0f} s"
        errors = f"{one.start_mm:>9.0f}{one.mean_mm:>8.2f}{one.p95_mm:>5.1f}"
        counts = f"{one.cameras:>7}{one.sightings:>10}{one.unmeasured:>9}{one.steps:>6}"
        lines.append(f"{counts}{times}{one.memory_mb:>5.0f}{one.message_mb:>6.1f}{errors}")
    return "\n".join(lines)


def _in_own_process(grid: tuple[int, int], seed: int, drive_s: float, floor_mm: float) -> Figures:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(calibrate_hall, grid, seed, drive_s, floor_mm).result()


def calibrate_hall(grid: tuple[int, int], seed: int, drive_s: float, floor_mm: float) -> Figures:
    """Simulate a hall, calibrate it, and compare it with its ground truth."""
    robots = max(grid[0] * grid[1] // 2, 2)
    settings = hall_settings(*grid, markers=robots, rate_hz=_RATE_HZ, drive_s=drive_s)
    scene = Scene(
        "hall",
        GeometricSettings(lab=settings, points=_POINTS, clock_offset_s=_CLOCK_S, floor_rms_m=floor_mm / _MM),
    )
    with threadpool_limits(1):
        session = make_session(scene, seed)
        observations, steps = observe_session(session), []
        begin_s = time.process_time()
        placed = place_cameras(observations)
        placed_s = time.process_time()
        fit = fit_jointly(observations, progress=lambda step, cost: steps.append(step))
        fit_s = time.process_time() - placed_s
        memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KB_PER_MB
        nodes = [_some(seen) for seen in nodes_of(session.lab)]
        errors = compute_errors(nodes, joint_locator(fit, session))
        error = summarize(errors, session.measured_m)
    return Figures(
        len(observations.cameras),
        sum(map(len, observations.sightings)),
        sum(not (sightings.point >= 0).any() for sightings in observations.sightings),
        placed_s - begin_s,
        fit_s,
        len(steps),
        memory_mb,
        len(encode(joint_payload(fit, session.pairs, 0))) / _BYTES_PER_MB,
        _MM * _largest_miss_m(session.lab, observations, placed),
        _MM * error.mean_m,
        _MM * error.p95_m,
        _MM * error.aligned_mean_m,
        *_stated(errors),
    )


def _largest_miss_m(lab: GeometricLab, observations: Observations, placed: list[PlacedCamera]) -> float:
    """Return the largest error of the origin of a camera."""
    origins_m = {camera.name: camera.origin_m for camera in lab.cameras}
    return max(
        float(np.linalg.norm(view.origin_m - origins_m[camera.name]))
        for view, camera in zip(placed, observations.cameras, strict=True)
    )


def _stated(errors: Sequence[SightingErrors]) -> tuple[float, float, float, float]:
    """Return the mean expected error in mm, the NEES, and the largest error with the expected one there."""
    apart_mm = _MM * np.concatenate([np.linalg.norm(one.errors_m, axis=1) for one in errors])
    covariances_m2 = np.concatenate([c for one in errors if (c := one.covariances_m2) is not None])
    shares = region_shares(np.concatenate([one.errors_m for one in errors]), covariances_m2)
    expected_mm, worst = _MM * mean_lengths(covariances_m2), int(apart_mm.argmax())
    return float(expected_mm.mean()), shares.nees, float(apart_mm[worst]), float(expected_mm[worst])


def _some(seen: KnownSightings) -> KnownSightings:
    return replace(
        seen,
        truth_m=seen.truth_m[::_EVERY_NODE],
        corners_px=seen.corners_px[::_EVERY_NODE],
        heights_m=seen.heights_m[::_EVERY_NODE],
    )


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--hall-labs", type=int, default=1, help="halls of each size, with other seeds")
    parser.add_argument("--hall-drive-s", type=float, default=60.0, help="duration of the drive, in s")
    parser.add_argument("--hall-floor-mm", type=float, default=0.0, help="unevenness of the floor (RMS)")


if __name__ == "__main__":
    command("hall")
