"""Times of positions by the joint model: cameras with wrong clocks get the time of the reference camera."""

from __future__ import annotations

from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Markers, Measurement, Positions
from ipsys_log.models.locate_corners import LocateCorners
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import geometric_rig, simulate_session


def test_positions_have_the_time_of_the_reference_camera() -> None:
    own = LabSettings(seed=3, rate_hz=10.0, drive_s=40.0, markers=2)
    lab = build_lab(GeometricSettings(lab=own, points=16, clock_offset_s=0.02))
    messages = list(simulate_session(lab))
    measurements = [m.payload for m in messages if isinstance(m.payload, Measurement)]
    seen = [message for message in messages if isinstance(message.payload, Markers)]
    markers = {
        camera.name: [message.payload for message in seen if message.camera == camera.name]
        for camera in lab.cameras
    }
    fit = fit_jointly(gather_observations(geometric_rig(lab), lab.calibrations, markers, measurements))
    locate = LocateCorners(joint_payload(fit, {}, 0))
    list(locate(next(message for message in messages if message.topic == "/rig")))
    offsets_ns: dict[str, int] = {}
    for message in seen:
        for payload in (one for one in locate(message) if isinstance(one, Positions)):
            offsets_ns |= {str(message.camera): p.time_offset_ns or 0 for p in payload.positions}
    late_ns = lab.clock_offsets_ns
    reference = min(offsets_ns, key=lambda camera: abs(offsets_ns[camera]))
    assert max(late_ns.values()) - min(late_ns.values()) > 10_000_000
    for camera, offset_ns in offsets_ns.items():
        assert abs(offset_ns - (late_ns[reference] - late_ns[camera])) < 500_000
