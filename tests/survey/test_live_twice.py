"""Live measurement: detection of a marker that is still at its measured point."""

import numpy as np

from ipsys_log.capture.frames import CameraState
from ipsys_log.live_runs.survey.checks import EntryCheck, check_entry, withdrawal_of
from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.live_runs.survey.scene import observe_marker
from ipsys_log.messages import CameraPoint, CameraPoints, CompressedImage, Markers, Message
from ipsys_log.units import NS_PER_S
from tests import labs

PLACE = TypedEntry("0", {"A": "170", "B": "190"}, "left", "10")
BETTER = TypedEntry("0", {"A": "171", "B": "190"}, "left", "10")


class Lab:
    """A marker in front of one camera at 10 Hz, with the noise of plain corners."""

    def __init__(self) -> None:
        self.scene = LiveScene(labs.RIG, None, {"red": CameraState(up=True)}, lambda topic, payload: None)
        self._frame, self._rng = 0, np.random.default_rng(3)

    def show(self, seconds: float, x_m: float) -> None:
        for _ in range(round(seconds * 10)):
            self._frame += 1
            taken_ns = self._frame * NS_PER_S // 10
            x, y, z = np.array([x_m, 0.2, 2.0]) + self._rng.normal(0, [0.0005, 0.0005, 0.003])
            points = CameraPoints(taken_ns, (CameraPoint(0, x, y, z),))
            image = CompressedImage(taken_ns, "red", b"", "jpeg")
            for payload in (image, Markers(taken_ns, (), 960, 540), points):
                self.scene(Message("", taken_ns, taken_ns, payload, "red"))

    def check(self, typed: TypedEntry) -> EntryCheck:
        scene = self.scene
        sight = observe_marker(scene.views(None), 0)
        return check_entry(*parse_entry(typed, scene.rig), scene.rig, sight, scene.history())

    def save(self, typed: TypedEntry) -> None:
        checked = self.check(typed)
        assert checked.measurement is not None
        self.scene.add([checked.measurement])


def test_a_marker_that_has_not_moved_since_it_was_measured() -> None:
    lab = Lab()
    lab.show(2, 0.1)
    assert lab.check(PLACE).warnings == ()
    lab.save(PLACE)
    lab.show(4, 0.1)  # so that the two intervals have no common second
    assert "saved already as p001" in lab.check(PLACE).faults[0].text
    (text,) = lab.check(BETTER).warnings
    assert "marker 0 is already measured here, as p001" in text
    lab.save(BETTER)
    lab.show(2, 0.1)
    (text,) = lab.check(TypedEntry("0", {"A": "172", "B": "190"}, "left", "10")).warnings
    assert "as p001 (2.0 cm from here), p002 (1.0 cm from here)" in text
    for name in ("p001", "p002"):
        lab.scene.add([withdrawal_of(lab.scene.history(), name)])
    assert lab.check(BETTER).warnings == ()


def test_slightly_moved_marker_is_a_new_point() -> None:
    lab = Lab()
    lab.show(2, 0.1)
    lab.save(PLACE)
    lab.show(2, 0.13)
    assert lab.check(BETTER).warnings == ()
    # The marker is back at its point, so the point is the same.
    lab.show(2, 0.1)
    assert "already measured here" in lab.check(BETTER).warnings[0]
