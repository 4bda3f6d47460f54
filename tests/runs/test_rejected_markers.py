"""Remarks of detection on markers that are seen and cannot be measured."""

from pathlib import Path

from ipsys_log.engine.output import write_log
from tests.conftest import Ipsys
from tests.stages.drawing import VGA, calibrated, each_time, frame, jpeg, rig
from tests.stages.lighting import marker_in_glare


def test_detect_of_markers_in_glare_names_glare(ipsys: Ipsys, tmp_path: Path) -> None:
    path, data = tmp_path / "glossy.mcap", jpeg(marker_in_glare())
    write_log(path, [rig(), calibrated(VGA), *(frame(data, time_ns) for time_ns in each_time(3))])
    before = path.read_bytes()
    done = ipsys("detect", path)
    assert (done.code, done.out) == (1, "")
    assert "no marker could be measured in 3 frames" in done.err
    assert "marker 5 is seen and not measured: glare hides" in done.err
    assert "dictionary" not in done.err
    assert path.read_bytes() == before
