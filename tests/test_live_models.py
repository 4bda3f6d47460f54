"""Several live models: each has its own chain of stages, equal to a replay with that model alone."""

from math import inf
from pathlib import Path

import pytest

from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Latency
from ipsys_log.messages.channels import LATENCY, MODEL, POSITIONS, TRACKS
from ipsys_log.tools.verify import verify
from tests.conftest import Ipsys
from tests.live_recordings import RATE_HZ, lenses, sent
from tests.playing import SteppedClock, cameras, playing

MODELS = ("poly", "joint")
# Recordings, replays and verifications with two models.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def fitted(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log with both models."""
    path = tmp_path_factory.mktemp("models") / "calibration.mcap"
    pipeline.replay([lab_log], Request(models=MODELS), "fit", output=path)
    return path


@pytest.fixture(scope="module")
def recorded(lab_log: Path, fitted: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a live recording with both models and no skipped frame."""
    target, frames = tmp_path_factory.mktemp("models") / "live.mcap", sent(lab_log)
    clock = SteppedClock(list(frames), RATE_HZ)
    with Session([lab_log]) as session:
        (rig,) = session.payloads(["/rig"])
    attached = LiveCameras(cameras(*frames), playing(frames, inf, before=clock.before), clock)
    settings = first_messages(rig, lenses(lab_log), attached.now_ns)
    request = Request(models=MODELS, model_from=fitted)
    with attached:
        outcomes = pipeline.live(attached, settings, target, request, sinks=[clock.watch])
    assert [(one.stage, one.run) for one in outcomes] == [
        ("detect", "edges"),
        ("camera-frame", "edges"),
        *[(stage, "poly") for stage in ("fit", "locate", "fuse")],
        *[(stage, "joint") for stage in ("fit", "watch", "locate", "fuse")],
    ]
    return target


def test_two_models_live_equal_two_replays(recorded: Path, fitted: Path, tmp_path: Path) -> None:
    with Session([recorded]) as session:
        live = {topic: session.hash(topic) for topic in derived(session)}
        settings = [*session.topics(MODEL, "poly"), *session.topics(MODEL, "joint")]
        own = [topic for reader in session.readers for topic in reader.channels if "/runs/" not in topic]
        for model in MODELS:
            log = tmp_path / f"{model}.mcap"
            write_log(log, session.messages([topic for topic in own if topic != "/latency"]))
            pipeline.replay([log], Request(models=(model,), model_from=fitted))
            with Session([log]) as replayed:
                topics = derived(replayed)
                assert {topic: replayed.hash(topic) for topic in topics} == {t: live[t] for t in topics}
                assert {topic.split("/")[2] for topic in topics} == {"edges", model}
    assert len(settings) == 2


def derived(session: Session) -> list[str]:
    """Return the derived topics of a log, without models: a copied model has the time of the copy."""
    channels = {topic for reader in session.readers for topic in reader.channels}
    return sorted(t for t in channels if t.startswith("/runs/") and not t.endswith(("/record", "/model")))


def test_two_models_live_are_verified(recorded: Path) -> None:
    comparisons = verify([recorded], None, lambda stage, done, total: None)
    assert all(one.equal and one.left > 0 for one in comparisons)
    assert {f"/runs/{model}/tracks" for model in MODELS} <= {one.topic for one in comparisons}


def test_each_model_has_its_own_latencies(recorded: Path) -> None:
    with Session([recorded]) as session:
        latencies: list[Latency] = session.payloads(session.topics(LATENCY))
        tracks = [session.count(topic) for model in MODELS for topic in session.topics(TRACKS, model)]
    assert len(latencies) == sum(tracks)
    assert all(one.received <= one.detected <= one.located <= one.fused <= one.published for one in latencies)


def test_replay_finds_two_models_done(recorded: Path, fitted: Path, ipsys: Ipsys) -> None:
    before = recorded.read_bytes()
    outcomes = pipeline.replay([recorded], Request(models=MODELS, model_from=fitted))
    assert not any(one.fresh for one in outcomes)
    assert recorded.read_bytes() == before
    with Session([recorded]) as session:
        assert [session.topics(POSITIONS, model) != [] for model in MODELS] == [True, True]
