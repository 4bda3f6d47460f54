"""A session saved for Rerun, and read with Rerun's own reader."""

import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from ipsys_log.engine.output import write_log
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CompressedImage,
    Distance,
    Event,
    Floor,
    Marker,
    Markers,
    Measurement,
    Message,
    Position,
    Positions,
    RawImage,
    ReferencePoint,
    Rig,
    Run,
    Track,
    Tracks,
)
from ipsys_log.sinks.rerun.messages import RerunSink, encoded_frame, raw_image
from ipsys_log.sinks.rerun.recording import write_recording

START_NS = 1_700_000_000_000_000_001
STEP_NS = 100_000_000
# ten times, a pause, five more times
TIMES_NS = [START_NS + STEP_NS * n for n in (*range(10), *range(200, 205))]
DELAY_NS = 7_000_000
CAMERAS = ("red", "white")
RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    reference_points=(ReferencePoint("A", 1.0, 2.0), ReferencePoint("B", 3.0, 2.0)),
    floor=Floor(4.0, 5.0),
)


def jpeg(shade: int) -> bytes:
    ok, data = cv2.imencode(".jpg", np.full((48, 64), shade, np.uint8))
    assert ok
    return data.tobytes()


def corners_px(n: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([[10.25, 12.5], [20.0, 12.5], [20.0, 22.5], [10.0, 22.5]]) + n


def session_messages() -> Iterator[Message]:
    yield Message("/rig", START_NS, START_NS, RIG)
    for number, (split, side, d1) in enumerate(
        (("train", "left", 1.5), ("test", "right", 1.6), ("test", "left", 9.0))
    ):
        distances = (Distance("A", d1), Distance("B", 1.5))
        measurement = Measurement(
            START_NS, f"m{number}", marker_id=0, distances=distances, side=side, height_m=0.1, splits=(split,)
        )
        yield Message("/measurements", START_NS, START_NS, measurement)
    for n, time_ns in enumerate(TIMES_NS):
        log_ns = time_ns + DELAY_NS
        for camera in CAMERAS:
            image = CompressedImage(time_ns, camera, jpeg(10 * n), "jpeg")
            yield Message(f"/cameras/{camera}/image", log_ns, time_ns, image, camera)
            markers = Markers(time_ns, (Marker(0, corners_px(n)),) if n != 3 else (), 64, 48)
            yield Message(f"/runs/stock/cameras/{camera}/markers", log_ns, time_ns, markers, camera)
            positions = Positions(time_ns, (Position(0, 1 + 0.1 * n, 2.0, 0.1),))
            yield Message(f"/runs/poly/cameras/{camera}/positions", log_ns, time_ns, positions, camera)
            robots = (Track("robot_0", 0, 1 + 0.1 * n, 2.0, 0.1, 0.5), Track("robot_1", 1, 3.0, 0.1 * n, 0.1))
            # The second robot disappears during the pause, and one camera sees only the first robot.
            seen = robots[: 2 if n < 10 and camera == "white" else 1]
            yield Message("/runs/poly/tracks", log_ns, time_ns, Tracks(time_ns, seen))
        yield Message("/truth/tracks", log_ns, time_ns, Tracks(time_ns, robots))
    yield Message("/events", log_ns, log_ns, Event(log_ns, "camera_lost", "red is gone", "red"))
    for number, (run, stage, inputs) in enumerate((("stock", "detect", ()), ("poly", "fuse", ("stock",))), 1):
        record = Run(log_ns, run, stage, input_runs=inputs, number=number)
        yield Message(f"/runs/{run}/record", log_ns, log_ns, record)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "lab.mcap"
    write_log(path, session_messages())
    return path


@pytest.fixture(scope="module")
def saved(log: Path) -> Path:
    path = log.with_suffix(".rrd")
    with Session([log]) as session:
        shown = write_recording(session, save=path)
    assert (shown.markers, shown.runs) == ("stock", ("poly",))
    return path


def rows(path: Path, entity: str, column: str) -> list[tuple[int, int, Any]]:
    """Return publish time, log time and value of a component, in the order of time and writing."""
    found: list[tuple[int, int, Any]] = []
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and column in batch.schema.names:
            times = [batch.column(name).cast("int64").to_pylist() for name in ("publish_time", "log_time")]
            found += zip(*times, batch.column(column).to_pylist(), strict=True)
    return sorted(found, key=lambda row: row[0])


def test_recording_is_sound_and_has_what_the_log_has(saved: Path) -> None:
    verified = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(saved)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert verified.returncode == 0, verified.stderr
    chunks = RrdReader(saved).stream().to_chunks()
    entities = {chunk.entity_path for chunk in chunks}
    expected = {
        f"/cameras/{camera}/image{part}" for camera in CAMERAS for part in ("", "/markers", "/markers/ids")
    }
    expected |= {f"/world/runs/poly/positions/{camera}" for camera in CAMERAS}
    expected |= {f"/world/runs/poly/robots/robot_{n}" for n in (0, 1)} | {"/world/runs/poly/trails"}
    expected |= {"/world/floor", "/world/floor/grid", "/world/reference_points", "/events/recorded"}
    expected |= {f"/world/{name}" for name in ("places/training", "places/test", "truth/robots/robot_1")}
    assert expected <= entities
    # Nothing depends on the clock of the drawing machine.
    assert {name for chunk in chunks for name in chunk.timeline_names} == {"publish_time", "log_time"}
    assert len(RrdReader(saved).blueprints()) >= 1


def test_frames_are_the_bytes_of_the_log(saved: Path) -> None:
    for camera in CAMERAS:
        frames = rows(saved, f"/cameras/{camera}/image", "EncodedImage:blob")
        assert [row[0] for row in frames] == TIMES_NS
        assert [row[1] for row in frames] == [time_ns + DELAY_NS for time_ns in TIMES_NS]
        assert [bytes(row[2][0]) for row in frames] == [jpeg(10 * n) for n in range(len(TIMES_NS))]


def test_corners_lie_half_a_pixel_from_opencvs(saved: Path) -> None:
    drawn = {row[0]: row[2] for row in rows(saved, "/cameras/red/image/markers", "LineStrips2D:strips")}
    assert TIMES_NS[3] not in drawn
    (outline,) = drawn[TIMES_NS[5]]
    np.testing.assert_allclose(np.array(outline)[:4] - 0.5, corners_px(5))
    assert outline[0] == outline[-1]
    cleared = rows(saved, "/cameras/red/image/markers", "Clear:is_recursive")
    assert TIMES_NS[3] in {row[0] for row in cleared}


def test_robots_have_the_positions_of_the_log(saved: Path) -> None:
    for robot, axis, start in (("robot_0", 0, 1.0), ("robot_1", 1, 0.0)):
        drawn = rows(saved, f"/world/runs/poly/robots/{robot}", "Points3D:positions")
        assert {row[0] for row in drawn} == set(TIMES_NS if robot == "robot_0" else TIMES_NS[:10])
        for time_ns, _, points in drawn:
            assert points[0][axis] == pytest.approx(start + 0.1 * TIMES_NS.index(time_ns), abs=1e-6)


def looks_at(path: Path, entity: str, kind: str, moved: str, look: str) -> dict[int, Any]:
    """Return the visible style at each publish time; None if a viewer has none."""
    drawn = [(time_ns, 2, None) for time_ns, _, _ in rows(path, entity, f"{kind}:{moved}")]
    given = [(time_ns, 1, value) for time_ns, _, value in rows(path, entity, f"{kind}:{look}")]
    parents = ["/".join(entity.split("/")[:depth]) for depth in range(2, entity.count("/") + 2)]
    cleared = [
        (time_ns, 0, None) for parent in parents for time_ns, _, _ in rows(path, parent, "Clear:is_recursive")
    ]
    in_force: Any = None
    found: dict[int, Any] = {}
    for time_ns, what, value in sorted(drawn + given + cleared, key=lambda event: event[:2]):
        if what == 2:
            found[time_ns] = in_force
        else:
            in_force = value
    return found


def test_drawn_objects_keep_their_style_after_they_disappear(saved: Path) -> None:
    robot = "/world/runs/poly/robots/robot_0"
    labels = looks_at(saved, robot, "Points3D", "positions", "labels")
    assert labels == {time_ns: ["robot_0"] for time_ns in TIMES_NS}
    assert None not in looks_at(saved, robot, "Points3D", "positions", "colors").values()
    headings = looks_at(saved, f"{robot}/heading", "Arrows3D", "vectors", "colors")
    assert headings.keys() == set(TIMES_NS)
    assert None not in headings.values()
    seen = [time_ns for time_ns in TIMES_NS if time_ns != TIMES_NS[3]]
    ids = looks_at(saved, "/cameras/red/image/markers/ids", "Points2D", "positions", "labels")
    assert ids == {time_ns: ["0"] for time_ns in seen}
    positions = looks_at(saved, "/world/runs/poly/positions/red", "Points3D", "positions", "labels")
    assert positions == {time_ns: ["0 (red)"] for time_ns in TIMES_NS}


MARKER = (Marker(0, corners_px(0)),)


def drawn_by(path: Path, messages: Iterable[Message], fade_ns: Mapping[str, int] | None = None) -> Path:
    recording = rr.RecordingStream("ipsys", send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    recording.save(path)
    sink = RerunSink(recording, CAMERAS, fade_ns or {}, ("poly",))
    for message in messages:
        sink(message)
    sink.close()
    recording.disconnect()
    return path


def test_look_of_late_message_holds_for_it_alone(tmp_path: Path) -> None:
    """Positions of another marker arrive after their exposure: each keeps its own label."""
    taken = [(10, 0), (5, 1), (12, 0), (7, 1), (13, 0), (14, 0)]
    messages = [
        Message(
            "/runs/poly/cameras/red/positions",
            START_NS + number,
            START_NS + time_ns,
            Positions(START_NS + time_ns, (Position(marker, 1.0, 2.0, 0.1),)),
            "red",
        )
        for number, (time_ns, marker) in enumerate(taken)
    ]
    saved = drawn_by(tmp_path / "late.rrd", messages)
    labels = looks_at(saved, "/world/runs/poly/positions/red", "Points3D", "positions", "labels")
    assert labels == {START_NS + time_ns: [f"{marker} (red)"] for time_ns, marker in taken}


def test_late_message_clears_nothing_that_was_drawn_after_it(tmp_path: Path) -> None:
    topic = "/runs/edges/cameras/red/markers"
    taken = [(10, True), (12, True), (11, False), (13, True), (9, False), (14, True), (15, False), (16, True)]
    messages = [
        Message(
            topic, START_NS + n, START_NS + t, Markers(START_NS + t, MARKER if seen else (), 64, 48), "red"
        )
        for n, (t, seen) in enumerate(taken)
    ]
    saved = drawn_by(tmp_path / "late.rrd", messages)
    entity = "/cameras/red/image/markers"
    ids = looks_at(saved, f"{entity}/ids", "Points2D", "positions", "labels")
    assert ids == {START_NS + t: ["0"] for t, seen in taken if seen}
    assert [row[0] - START_NS for row in rows(saved, entity, "Clear:is_recursive")] == [15]


def test_markers_keep_their_style_after_their_image_disappears(tmp_path: Path) -> None:
    def frame(time_ns: int) -> Message:
        return Message(
            "/cameras/red/image", time_ns, time_ns, CompressedImage(time_ns, "red", jpeg(1), "jpeg"), "red"
        )

    def markers(time_ns: int) -> Message:
        payload = Markers(time_ns, MARKER, 64, 48)
        return Message("/runs/edges/cameras/red/markers", time_ns, time_ns, payload, "red")

    late_ns = START_NS + 20 * STEP_NS
    messages = [frame(START_NS), markers(START_NS), frame(late_ns), markers(late_ns)]
    saved = drawn_by(tmp_path / "a.rrd", messages, {"/cameras/red/image": 10 * STEP_NS})
    ids = looks_at(saved, "/cameras/red/image/markers/ids", "Points2D", "positions", "labels")
    assert ids == {START_NS: ["0"], late_ns: ["0"]}


def test_robot_without_heading_loses_its_arrow(tmp_path: Path) -> None:
    messages = [
        Message("/runs/poly/tracks", time_ns, time_ns, Tracks(time_ns, (Track("a", 0, 1, 2, 0.1, heading),)))
        for time_ns, heading in zip(TIMES_NS, (0.1, 0.2, None, None, 0.3), strict=False)
    ]
    saved = drawn_by(tmp_path / "a.rrd", messages)
    arrow = "/world/runs/poly/robots/a/heading"
    assert [row[0] for row in rows(saved, arrow, "Clear:is_recursive")] == [TIMES_NS[2]]
    assert looks_at(saved, arrow, "Arrows3D", "vectors", "colors").keys() == {TIMES_NS[n] for n in (0, 1, 4)}
    assert None not in looks_at(saved, arrow, "Arrows3D", "vectors", "colors").values()


def test_robot_that_can_tilt_has_arrows_forward_and_up(tmp_path: Path) -> None:
    sent = Tracks(START_NS, (Track("a", 0, 1, 2, 0.1, 2.0, rotation_rad=np.array([0.5, -0.3, 2.0])),))
    saved = drawn_by(tmp_path / "a.rrd", [Message("/runs/poly/tracks", START_NS, START_NS, sent)])
    ((_, _, vectors),) = rows(saved, "/world/runs/poly/robots/a/heading", "Arrows3D:vectors")
    turn = Rotation.from_rotvec([0.5, -0.3, 2.0])
    assert np.array(vectors) == pytest.approx(turn.apply([[0.3, 0, 0], [0, 0, 0.15]]), abs=1e-6)


def test_unseen_objects_disappear_from_the_view(saved: Path) -> None:
    for entity in ("runs/poly/robots/robot_1", "runs/poly/robots/robot_0", "runs/poly/positions/red"):
        cleared = rows(saved, f"/world/{entity}", "Clear:is_recursive")
        # one second after the last of the first ten times, not at the end of the log
        assert [row[:2] for row in cleared if row[0] > TIMES_NS[9]] == [
            (TIMES_NS[9] + 10**9, TIMES_NS[9] + DELAY_NS + 10**9)
        ]
    assert rows(saved, "/cameras/red/image", "Clear:is_recursive")[0][0] == TIMES_NS[9] + 10**10


def test_trail_has_a_line_per_step_and_none_over_a_gap(saved: Path) -> None:
    drawn = rows(saved, "/world/runs/poly/trails", "LineStrips3D:strips")
    robot_0 = [(time_ns, strips[0]) for time_ns, _, strips in drawn if strips[0][0][1] == 2.0]
    assert [time_ns for time_ns, _ in robot_0] == TIMES_NS[1:10] + TIMES_NS[11:]
    assert robot_0[0][1][1][0] == pytest.approx(1.1)


def test_point_without_a_triangle_is_excluded_and_reported(saved: Path) -> None:
    chunks = RrdReader(saved).stream().to_chunks()
    batches = [c.to_record_batch() for c in chunks if c.entity_path == "/events/measurements"]
    ((text,),) = [row for batch in batches for row in batch.column("TextLog:text").to_pylist()]
    assert "m2" in text


def test_bad_requests_are_refused_and_leave_nothing(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out.rrd"
    with Session([log]) as session:
        with pytest.raises(IpsysError, match=r"no run 'nix'.*stock, poly"):
            write_recording(session, ["nix"], target)
        with pytest.raises(FileNotFoundError):
            write_recording(session, save=tmp_path / "none" / "out.rrd")

        def broken(*_: object) -> Iterator[Message]:
            yield next(session_messages())
            raise LogError("damaged")

        monkeypatch.setattr(session, "messages", broken)
        with pytest.raises(LogError, match="damaged"):
            write_recording(session, save=target)
    assert list(tmp_path.iterdir()) == []


def test_log_with_nothing_to_show_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    write_log(path, [Message("/rig", START_NS, START_NS, RIG)])
    with Session([path]) as session, pytest.raises(IpsysError, match="nothing to show"):
        write_recording(session, save=tmp_path / "out.rrd")


def test_named_runs_include_their_input_markers(log: Path, tmp_path: Path) -> None:
    with Session([log]) as session:
        shown = write_recording(session, ["stock"], tmp_path / "out.rrd")
        assert (shown.markers, shown.runs) == ("stock", ())
        assert write_recording(session, ["poly"], tmp_path / "out.rrd").markers == "stock"


def content_of(path: Path) -> dict[tuple[str, str], list[tuple[int, int, str]]]:
    """Return the values of a recording with their times, by entity and component."""
    found: dict[tuple[str, str], list[tuple[int, int, str]]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        if "log_time" not in batch.schema.names:  # the description of the recording
            continue
        times = [batch.column(name).cast("int64").to_pylist() for name in ("publish_time", "log_time")]
        for name in (name for name in batch.schema.names if ":" in name):
            values = batch.column(name).to_pylist()
            given = [row for row in zip(*times, map(repr, values), strict=True) if row[2] != "None"]
            found.setdefault((chunk.entity_path, name), []).extend(given)
    return {key: sorted(rows_) for key, rows_ in found.items() if rows_}


def test_recording_is_the_same_with_any_batches(
    saved: Path, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without batches, each row is drawn alone: a recording then shows what each message gives."""
    path = tmp_path / "single.rrd"
    monkeypatch.setattr("ipsys_log.sinks.rerun.recording._BATCH", 1)
    monkeypatch.setattr("ipsys_log.sinks.rerun.messages._MOST_WAITING_BYTES", 1)
    with Session([log]) as session:
        write_recording(session, save=path)
    assert content_of(path) == content_of(saved)


def test_frames_do_not_wait_in_memory_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file has all frames but those of the last batch, however slow the disk is."""
    size = 1 << 20
    monkeypatch.setattr("ipsys_log.sinks.rerun.messages._MOST_WAITING_BYTES", 4 * size)
    path, chance = tmp_path / "frames.rrd", np.random.default_rng(0)
    missing: list[int] = []

    def frames() -> Iterator[Message]:
        for number in range(40):
            time_ns = START_NS + number
            image = CompressedImage(time_ns, "red", b"\xff\xd8\xff" + chance.bytes(size), "jpeg")
            yield Message("/cameras/red/image", time_ns, time_ns, image, "red")
            # The sink asks for the next frame when it has drawn this one.
            missing.append((number + 1) * size - path.stat().st_size)

    drawn_by(path, frames())
    assert max(missing) < 4 * size


def test_damaged_frame_hides_the_frame_before_it(tmp_path: Path) -> None:
    """The frames wait for their batch; the one that cannot be drawn must come after them."""
    data = (jpeg(1), jpeg(2), b"damaged", jpeg(3))
    frames = [
        Message(
            "/cameras/red/image", time_ns, time_ns, CompressedImage(time_ns, "red", bytes_, "jpeg"), "red"
        )
        for time_ns, bytes_ in zip(TIMES_NS, data, strict=False)
    ]
    path = drawn_by(tmp_path / "damaged.rrd", frames)
    drawn = rows(path, "/cameras/red/image", "EncodedImage:blob")
    assert [row[0] for row in drawn] == [TIMES_NS[0], TIMES_NS[1], TIMES_NS[3]]
    assert [row[0] for row in rows(path, "/cameras/red/image", "Clear:is_recursive")] == [TIMES_NS[2]]
    order = [
        chunk.num_rows
        for chunk in RrdReader(path).stream().to_chunks()
        if chunk.entity_path == "/cameras/red/image"
    ]
    assert order == [2, 1, 1]


def test_raw_frames_lose_the_padding_of_their_rows() -> None:
    pixels = np.arange(2 * 8, dtype=np.uint8).reshape(2, 8)
    image = raw_image(RawImage(0, "red", 2, 2, "bgr8", 8, pixels.tobytes()))
    assert isinstance(image, rr.Image)
    assert image.buffer is not None
    assert bytes(image.buffer.as_arrow_array().to_pylist()[0]) == pixels[:, :6].tobytes()


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (RawImage(0, "red", 4, 4, "mono8", 4, b"123"), "too few"),
        (RawImage(0, "red", 4, 4, "bayer_rggb8", 4, bytes(16)), "bayer_rggb8"),
        (CompressedImage(0, "red", b"", "jpeg"), "0 bytes"),
        (CompressedImage(0, "red", b"RIFF....WEBP", "webp"), "webp"),
    ],
)
def test_frames_that_cannot_be_drawn_say_why(frame: CompressedImage | RawImage, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        raw_image(frame) if isinstance(frame, RawImage) else encoded_frame(frame)
