"""Clock estimates of nodes against the joint calibration of a simulated drive with known clock offsets."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from ipsys_log.api import python_api as api
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import ClockEstimate, Message, clock_topic
from ipsys_log.tools.soundness.references import check_clocks
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

MS = NS_PER_S // 1000


def with_estimates(lab: GeometricLab, bound_ns: int) -> Iterator[Message]:
    """Yield the messages of a session whose cameras are those of nodes, with one bound of their clocks."""
    last_ns = 0
    for message in simulate_session(lab):
        last_ns = message.log_time_ns
        yield message
    for number, camera in enumerate(lab.cameras, 1):
        now_ns = last_ns + number
        payload = ClockEstimate(now_ns, camera.name, "00112233445566ff", now_ns, 0, 0.0, bound_ns, 100)
        yield Message(clock_topic(camera.name), now_ns, now_ns, payload, camera.name)


def fitted_log(path: Path, lab: GeometricLab, bound_ns: int) -> Path:
    write_log(path, with_estimates(lab, bound_ns))
    api.replay(path, models=["joint"], until="fit")
    return path


# Three calibrations of a lab.
@pytest.mark.slow
def test_clock_beyond_its_bound_is_named_with_the_difference(tmp_path: Path, ipsys: Ipsys) -> None:
    own = LabSettings(seed=3, rate_hz=10.0, drive_s=20.0, markers=2, cameras=("red", "white"))
    lab = build_lab(GeometricSettings(lab=own, points=12, clock_offset_s=0.03))
    late_ns = lab.clock_offsets_ns["white"] - lab.clock_offsets_ns["red"]
    # The bound is that of both nodes.
    contradicted = fitted_log(tmp_path / "a.mcap", lab, abs(late_ns) // 2 - 3 * MS)
    with Session([contradicted]) as session:
        (finding,) = check_clocks(session)
        (camera,) = (name for name in ("red", "white") if finding.topic == clock_topic(name))
        sign = -1 if camera == "white" else 1
        difference_ms = float(finding.text.partition("by ")[2].partition(" ms")[0])
        assert difference_ms == pytest.approx(sign * late_ns / MS, abs=1)
    done = ipsys("check", contradicted)
    assert f"camera {camera}: the joint calibration corrects its clock by" in " ".join(done.out.split())
    for name, bound_ns, agreeing in (
        ("b", abs(late_ns) // 2 + 3 * MS, lab),
        ("c", 0, build_lab(GeometricSettings(lab=own, points=12))),
    ):
        with Session([fitted_log(tmp_path / f"{name}.mcap", agreeing, bound_ns)]) as session:
            assert list(check_clocks(session)) == []
