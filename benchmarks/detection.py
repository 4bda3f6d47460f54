"""Speed and accuracy of marker detection, from an MCAP log to corners, in one run.

    python benchmarks/detection.py --frames 150

Frames are from the simulated lab: three cameras of 1920 x 1080, and robots that drive. The pipelines (see
benchmarks/pipelines.py) take turns at the same frames, each in a separate process. With one thread, the
time is processor time; with three cameras in parallel, it is wall time. Corners are compared with the
simulator's ground truth, because a speed without accuracy means nothing. The script prints a table, and
writes JSON with -o.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from pipelines import Found, one_by_one, threaded
from results import Report, command
from rounds import Contender, Timing, race, ratio_row
from scenes import Truth, blocks, drawn, truth, with_restarts

from ipsys_log.capture.simulation.settings import LabSettings

__all__ = ["measure"]

# Number of frames of each camera that a pipeline processes in one turn. With parallel cameras, a core is
# idle during the last frames of a turn.
_INSTANTS, _INSTANTS_TOGETHER = 15, 30
# Corners with a larger mean distance than this belong to another object.
_SAME_PX = 10.0
# Suffix of a contender whose heap keeps freed memory.
_KEPT = ", heap kept"
_SEVERAL = "3 cameras at once"
_TAGS = "3 AprilTags (36h11)"
_RESTARTS = "3 markers, restarts"
_TEXTURED = "3 markers, textured"
_TEXTURED_TAGS = "3 AprilTags, textured"
_FIRST = ("plain", "stateless", "reset", "tracking")
_MARKERS = (3, 1, 8)


@dataclass(frozen=True, slots=True)
class Scene:
    """A log for a race; ``together``: all cameras are processed in parallel."""

    name: str
    path: Path
    settings: LabSettings
    finders: Sequence[str]
    together: bool = False


def _titled(markers: int) -> str:
    return f"{markers} marker{'s' * (markers > 1)}"


def _scenes(lab: Mapping[str, Any], report: Report) -> list[Scene]:
    ours = ("plain", "stock", "stateless", "tracking", "decode", "read")
    settings = {markers: LabSettings(**lab, markers=markers) for markers in _MARKERS}
    scenes = [
        Scene(_titled(n), drawn(lab_settings), lab_settings, ours) for n, lab_settings in settings.items()
    ]
    three = scenes[0] = replace(scenes[0], finders=(*ours, "plain" + _KEPT, "tracking" + _KEPT))
    scenes.append(Scene(_SEVERAL, three.path, three.settings, ("plain3", "ours3"), together=True))
    for name, dictionary in ((_TEXTURED, "DICT_4X4_100"), (_TEXTURED_TAGS, "DICT_APRILTAG_36h11")):
        textured = LabSettings(**lab, textured=True, dictionary=dictionary)
        scenes.append(Scene(name, drawn(textured), textured, _FIRST))
    restarts = with_restarts(three.path)
    if restarts is None:
        report.remarks.append("no restart markers: install jpegtran (Debian: libjpeg-turbo-progs)")
    else:
        scenes.append(Scene(_RESTARTS, restarts, three.settings, ("plain", "tracking", "decode")))
    if find_spec("pupil_apriltags") is None:
        report.remarks.append("no AprilTag: pupil-apriltags has no wheel for this Python")
    else:
        tags = LabSettings(**lab, dictionary="DICT_APRILTAG_36h11")
        scenes.append(Scene(_TAGS, drawn(tags), tags, ("apriltags", "plain", "stateless", "tracking")))
    return scenes


def _contender(scene: Scene, finder: str, ranges: Sequence[tuple[int, int]]) -> Contender:
    if finder == "ours3":
        return Contender(finder, threaded, (scene.path, ranges))
    if finder == "plain3":
        return Contender(finder, one_by_one, (scene.path, ranges, "plain", -1))
    name = finder.removesuffix(_KEPT)
    return Contender(finder, one_by_one, (scene.path, ranges, name, 1, name != finder))


def score(found: Sequence[Found], known: Mapping[tuple[str, int], Truth]) -> dict[str, Any]:
    """Return the errors of corners against ground truth, and the share of whole markers that were detected.

    An id is wrong if ground truth has no such marker within 10 px, or if it was detected before.
    """
    off_px: list[float] = []
    wrong = seen = 0
    for camera, time_ns, markers in found:
        frame = known[camera, time_ns]
        left = dict(frame.corners_px)
        for marker_id, corners_px in markers:
            true_px = left.pop(marker_id, None)
            if true_px is None or np.linalg.norm(corners_px - true_px, axis=1).mean() > _SAME_PX:
                wrong += 1
            elif marker_id in frame.whole:
                seen += 1
                off_px.extend(np.linalg.norm(corners_px - true_px, axis=1))
    there_are = sum(len(known[camera, time_ns].whole) for camera, time_ns, _ in found)
    return {
        "rms_px": float(np.sqrt(np.mean(np.square(off_px)))) if off_px else None,
        "max_px": float(max(off_px)) if off_px else None,
        "found": seen / there_are if there_are else None,
        "markers": there_are,
        "wrong_ids": wrong,
    }


def _race(scene: Scene, rounds: int, report: Report) -> dict[str, Timing]:
    ranges = blocks(scene.path, _INSTANTS_TOGETHER if scene.together else _INSTANTS)
    contenders = [_contender(scene, finder, ranges) for finder in scene.finders]
    timings = race(contenders, len(ranges), rounds)
    known = truth(scene.path, scene.settings)
    lines = [f"{scene.name:<22} {'ms/frame':>9} {'RMS px':>8} {'max px':>8} {'found':>8} {'wrong ids':>9}"]
    details: dict[str, Any] = {}
    for finder, timing in timings.items():
        frames = [frame for turn in timing.kept for frame in turn]
        if {(camera, time_ns) for camera, time_ns, _ in frames} != known.keys():
            raise SystemExit(f"{scene.name}: {finder} has not looked at every frame")
        taken_s = timing.wall_s if scene.together else timing.cpu_s
        ms = [1e3 * s / len(frames) for s in taken_s]
        quality = {} if finder in ("decode", "read") else score(frames, known)
        details[finder] = {
            "ms_per_frame": ms,
            "wall_ms_per_frame": [1e3 * s / len(frames) for s in timing.wall_s],
            "cpu_ms_per_frame": [1e3 * s / len(frames) for s in timing.cpu_s],
            "page_faults_per_frame": [faults / len(frames) for faults in timing.faults],
            **quality,
        }
        line = f"  {finder:<20} {float(np.median(ms)):9.2f}"
        if quality.get("rms_px") is not None:
            line += f" {quality['rms_px']:8.4f} {quality['max_px']:8.3f}"
            line += f" {100 * quality['found']:7.2f}% {quality['wrong_ids']:9d}"
        lines.append(line)
    report.details[scene.name] = details
    report.tables.append("\n".join(lines))
    return timings


def measure(options: argparse.Namespace) -> Report:
    """Race the pipelines on every scene."""
    report = Report("detection")
    frames = 4 if options.smoke else options.frames
    small = {"width": 640, "height": 360} if options.smoke else {}
    lab: dict[str, Any] = {"stations": 0, "drive_s": frames / 30, **small}
    raced = {
        scene.name: _race(scene, options.rounds, report)
        for scene in _scenes(lab, report)
        if not options.scene or options.scene in scene.name
    }

    def add(
        scene: str, over: str, under: str, wanted: tuple[str, float] | None = None, title: str = ""
    ) -> None:
        if scene in raced:
            timings = raced[scene]
            together = scene == _SEVERAL
            name = title or f"{over} / {under}, {scene}"
            report.rows.append(ratio_row(name, timings[over], timings[under], wanted, together))

    add("3 markers", "plain", "tracking", (">=", 4.5), "plain / tracking")
    add("3 markers", "tracking", "decode", ("<=", 1.3), "tracking / decode only")
    add("3 markers", "plain", "stateless", (">=", 3.5), "plain / stateless")
    add(_TEXTURED, "plain", "stateless", (">=", 3.0), "plain / stateless, textured floor")
    add(_TEXTURED, "plain", "reset", None, "plain / after a reset, textured floor")
    add(_TEXTURED_TAGS, "plain", "stateless", (">=", 2.0), "plain / stateless, textured floor, 36h11")
    add(_TEXTURED_TAGS, "plain", "reset", None, "plain / after a reset, textured floor, 36h11")
    add(_TEXTURED, "plain", "tracking", None, "plain / tracking, textured floor")
    add(_SEVERAL, "plain3", "ours3", (">=", 6.0), "plain / ours, 3 cameras at once")
    add(_RESTARTS, "plain", "tracking", (">=", 7.0), "plain / tracking, restart markers")
    add(_TAGS, "apriltags", "tracking", None, "apriltags / tracking, 36h11")
    add(_TAGS, "apriltags", "stateless", None, "apriltags / stateless, 36h11")
    add("3 markers", "plain" + _KEPT, "tracking" + _KEPT, None, "plain / tracking, heap kept")
    add("3 markers", "plain", "stock", None, "plain / stock")
    for markers in _MARKERS[1:]:
        add(_titled(markers), "plain", "tracking")
        add(_titled(markers), "tracking", "decode")
        add(_titled(markers), "plain", "stateless")
    add(_RESTARTS, "tracking", "decode")
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--frames", type=int, default=150, help="of each camera, one after the other")
    parser.add_argument("--scene", default="", help="only scenes with this in their name")


if __name__ == "__main__":
    command("detection")
