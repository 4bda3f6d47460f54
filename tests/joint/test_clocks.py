"""Clock offsets of cameras, in one recording and in several."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.calibration.joint.moved_cameras import find_motion, sum_squares
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Markers, Measurement, Message
from ipsys_log.units import NS_PER_S
from tests.geometric.knocks import drive_messages
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import geometric_rig, simulate_session
from tests.joint.test_drives import COARSE, gather, make_drive, observe


def test_reference_clock_is_of_a_camera_that_saw_the_drive() -> None:
    lab = build_lab(
        GeometricSettings(lab=LabSettings(seed=3, rate_hz=10.0, drive_s=20.0, markers=2), points=20)
    )
    messages = list(simulate_session(lab))
    measurements = [m.payload for m in messages if isinstance(m.payload, Measurement)]
    markers = {
        camera.name: [
            m.payload for m in messages if isinstance(m.payload, Markers) and m.camera == camera.name
        ]
        for camera in lab.cameras
    }
    gathered = gather_observations(geometric_rig(lab), lab.calibrations, markers, measurements)
    first, *others = gathered.sightings
    observations = replace(gathered, sightings=(first.select(first.point >= 0), *others))
    clocks_s = [model.clock_s for model in build_models(fit_jointly(observations)).values()]
    # All clocks of this lab agree.
    np.testing.assert_allclose(clocks_s, 0.0, atol=0.0005)


def fit_clock(wobble_deg: float) -> tuple[float, float]:
    """Return the clock offset of the second of two cameras, and its standard deviation, in s."""
    lab = LabSettings(seed=3, rate_hz=10.0, drive_s=30.0, markers=1, cameras=("red", "white"))
    # Exact corners: the wobble is the only difference between two labs of the same seed.
    lab_settings = GeometricSettings(lab=lab, points=8, wobble_deg=wobble_deg, corner_noise=0.0)
    fit = fit_jointly(observe(build_lab(lab_settings)), COARSE)
    column = fit.problem.layout.cameras[1].edge + 1
    return float(fit.state.values[column]), float(np.sqrt(fit.covariance[column, column]))


def test_wobble_of_a_robot_does_not_move_its_clocks() -> None:
    (level_s, sigma_s), (tilted_s, _) = fit_clock(0.0), fit_clock(0.1)
    assert abs(tilted_s - level_s) < 0.1 * sigma_s


def test_cameras_without_clock_offsets_have_common_instants() -> None:
    """Estimates of clocks and row times that may be 0 are 0 in the models, so that instants stay equal."""
    lab = LabSettings(seed=3, rate_hz=10.0, drive_s=30.0, markers=1, cameras=("red", "white"))
    fit = fit_jointly(observe(build_lab(GeometricSettings(lab=lab, points=8))))
    edges = [block.edge for block in fit.problem.layout.cameras]
    assert fit.state.values[[edge + 1 for edge in edges]].any()
    assert {(model.clock_s, model.row_time_s) for model in build_models(fit).values()} == {(0.0, 0.0)}
    offset = GeometricSettings(lab=lab, points=8, clock_offset_s=0.01)
    clocks_s = [model.clock_s for model in build_models(fit_jointly(observe(build_lab(offset)))).values()]
    assert np.count_nonzero(clocks_s) == 1


def on_next_day(messages: Iterable[Message]) -> Iterator[Message]:
    """Yield the markers of messages, one day later."""
    for message in messages:
        if isinstance(frame := message.payload, Markers):
            later = replace(frame, timestamp=frame.timestamp + 86_400 * NS_PER_S)
            yield replace(message, payload=later)


def test_each_recording_has_its_own_clock_offsets() -> None:
    lab = make_drive(seconds=15.0)
    (red, red_ns), (white, white_ns) = lab.clock_offsets_ns.items()
    # The same lab without measured points; its second camera was started again.
    drive = replace(lab, points=(), clock_offsets_ns={red: red_ns, white: white_ns + 40_000_000})
    fit = fit_jointly(gather([*simulate_session(lab), *on_next_day(simulate_session(drive))]), COARSE)
    layout = fit.problem.layout
    true_s = np.array([red_ns - white_ns, red_ns - white_ns - 40_000_000]) / NS_PER_S
    columns = [layout.clock(1, recording) for recording in (0, 1)]
    sigmas_s = np.sqrt(fit.covariance[columns, columns])
    assert (sigmas_s < 0.001).all()
    assert (abs(fit.state.values[columns] - true_s) < 4 * sigmas_s).all()
    assert build_models(fit)["white"].clock_s == fit.state.values[columns[1]]


def test_image_motion_by_temperature_is_no_moved_camera() -> None:
    lab = make_drive(seconds=30.0)
    warming = on_next_day(drive_messages(lab, warming_px=1.0))
    squares = sum_squares(fit_jointly(gather([*simulate_session(lab), *warming]), COARSE))
    assert [find_motion(squares, camera) for camera in range(2)] == [None, None]


def test_long_drive_is_used_in_parts() -> None:
    lab = LabSettings(seed=3, rate_hz=2.0, drive_s=1200.0, markers=1, cameras=("red", "white"))
    times_s = np.concatenate(
        [one.times_s[one.point < 0] for one in observe(build_lab(GeometricSettings(lab=lab))).sightings]
    )
    parts = np.unique(times_s // 10)
    assert len(parts) == 60
    assert np.ptp(parts) > 100
