"""The dashboard of a played log: ``ipsys stream LOG --web``."""

import json
import re
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.app.web.dashboard.app import dashboard_of_player
from ipsys_log.app.web.dashboard.pictures import EVERY_NS
from ipsys_log.app.web.dashboard.state import PlayedLog
from ipsys_log.live_runs.player import Player
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import LATENCY, TRACKS
from ipsys_log.sinks.playback import PlaybackOptions
from tests.cli.test_stream_command import started, stop
from tests.conftest import Ipsys
from tests.sinks.streaming import write_tracks
from tests.test_bad_input import refused
from tests.waiting import wait_until
from tests.web.axe import serious_faults
from tests.web.contrast import low_contrasts
from tests.web.dashboards import page_of
from tests.web.phone import Phone
from tests.web.test_access import Caller
from tests.web.test_dashboard_page import Reader, cookie_of, post
from tests.web.test_measuring_page import says

FAST = 10.0
# Two instants or more of each camera.
STEPS = 12


@contextmanager
def shown(log: Path, host: str | None = None, **options: Any) -> Iterator[tuple[Player, str]]:
    """A playing log and the address of its page; the playback waits at first."""
    player = Player([log], options=PlaybackOptions(start_paused=True, **options), has_dashboard=True)
    assert player.scene is not None
    dashboard = dashboard_of_player(player, player.scene)
    player.show_on(dashboard)
    with page_of(dashboard, host) as page, player:
        yield player, page.url


def test_played_log_fills_the_page(recorded: Path) -> None:
    with Session([recorded]) as session:
        tracks = session.payloads(session.topics(TRACKS, "poly"))
        cameras, has_latencies = sorted(session.images), session.count(LATENCY.topic) > 0
    with shown(recorded) as (player, url), closing(Reader(url)) as reader:
        caller = Caller(url)
        scene = json.loads(caller.ask("GET", "/api/scene")[1])
        assert (scene["played"], scene["may_operate"]) == (True, False)
        assert scene["floor"]["views"]
        status = reader.next("status")
        assert [camera["name"] for camera in status["cameras"]] == cameras
        assert all("dropped" not in camera for camera in status["cameras"])
        assert (status["playback"]["is_paused"], "recording" in status) == (True, False)
        player.rate = FAST
        player.resume()
        last = {track.robot: track.x_m for row in tracks for track in row.tracks}
        data = reader.until("robots", lambda data: len(data["robots"]) == len(last))
        assert {row["name"] for row in data["robots"]} == set(last)
        final = reader.until("status", lambda data: data["end"])
        assert bool(final["latency"]) is has_latencies


def step_from(player: Player, share: float) -> None:
    """Move a paused player to a share of its log, and play some instants from there."""
    player.seek(share * player.duration_s)
    for _ in range(STEPS):
        player.step()


def test_seek_back_begins_new_trails(recorded: Path) -> None:
    with shown(recorded) as (player, url), closing(Reader(url)) as reader:
        step_from(player, 0.5)
        late = reader.until("robots", lambda data: data["robots"])
        step_from(player, 0.0)
        early = reader.until("robots", lambda data: data["session"] > late["session"] and data["robots"])
        assert early["now"] < late["now"]
        trails = json.loads(Caller(url).ask("GET", "/api/scene")[1])["trails"]
        assert trails
        assert max(time_ms for points in trails.values() for time_ms, *_ in points) < late["now"]
        player.stop()


def test_paused_page_has_the_pictures_of_its_instant(recorded: Path) -> None:
    with shown(recorded) as (player, url), closing(Reader(url)) as reader:
        step_from(player, 0.0)
        tiles = reader.until("tiles", lambda data: all("picture" in one for one in data["cameras"]))
        assert reader.until("status", lambda data: data["playback"]["is_paused"])
        addresses = [one["picture"] for one in tiles["cameras"]]
        assert [Caller(url).ask("GET", f"/{one}")[0] for one in addresses] == [200] * len(addresses)
        player.stop()


def test_pictures_follow_the_rate_and_all_are_shown_in_a_pause(tmp_path: Path) -> None:
    options = PlaybackOptions(start_paused=True)
    with Player([write_tracks(tmp_path / "x.mcap")], options=options, has_dashboard=True) as player:
        assert player.scene is not None
        played = PlayedLog(player, player.scene)
        assert played.picture_every_ns() == 0
        player.rate = 2.0
        player.resume()
        assert played.picture_every_ns() == 2 * EVERY_NS
        player.stop()


def test_page_of_a_log_offers_no_action(tmp_path: Path) -> None:
    with shown(write_tracks(tmp_path / "x.mcap")) as (player, url):
        caller = Caller(url)
        for path in ("/api/operate", "/api/mark", "/api/segment"):
            status, answer = post(caller, path, {})
            assert (status, "only shows a log" in answer["error"]) == (400, True)
        player.stop()


def test_page_is_refused_before_the_log_is_played(ipsys: Ipsys, tmp_path: Path) -> None:
    log = write_tracks(tmp_path / "x.mcap", 3)
    assert "or add --web" in refused(ipsys, log, "stream", log)
    assert "--web-port: has no effect without --web" in refused(
        ipsys, log, "stream", log, "--udp", "9870", "--web-port", "8000"
    )
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert "is in use" in refused(ipsys, log, "stream", log, "--web", "--web-port", port)


def test_command_serves_a_log_without_a_stream(tmp_path: Path) -> None:
    log = write_tracks(tmp_path / "x.mcap")
    program = started("stream", log, "--web", "--web-port", 0, "--loop")
    assert program.stderr is not None
    try:
        line = next(line for line in program.stderr if "dashboard at" in line)
        match = re.search(r"http://\S+", line)
        assert match is not None
        with closing(Reader(match[0])) as reader:
            assert reader.next("status")["playback"]["loops"] is True
            robots = reader.until("robots", lambda data: data["robots"])["robots"]
            assert {row["name"] for row in robots} <= {"ada", "bob"}
    finally:
        stop(program)


def test_device_that_operates_plays_the_log(tmp_path: Path) -> None:
    log = write_tracks(tmp_path / "x.mcap")
    with shown(log) as (player, url), closing(Reader(url)) as reader:
        caller = Caller(url)
        assert post(caller, "/api/play", {"rate": 5})[1]["rate"] == player.rate == 5
        assert post(caller, "/api/play", {"seconds": 1.2})[1]["seconds"] == pytest.approx(1.2, abs=0.05)
        # A paused page shows the robots at the new time.
        robots = reader.until("robots", lambda data: data["robots"])["robots"]
        ada = next(row for row in robots if row["name"] == "ada")
        assert ada["x"] <= 1 + 0.25 * 1.2
        reader.until("robots", lambda data: any(row["x"] == pytest.approx(1.29) for row in data["robots"]))
        assert player.position_s == pytest.approx(1.2)
        for body in ({"rate": 0}, {"rate": "fast"}, {"seconds": True}, {"seconds": float("nan")}):
            assert post(caller, "/api/play", body)[0] == 400
        assert (player.is_paused, player.rate) == (True, 5)
        assert post(caller, "/api/play", {"is_paused": False})[1]["is_paused"] is False
        player.stop()


def test_device_that_views_cannot_play_the_log(tmp_path: Path) -> None:
    player = Player([write_tracks(tmp_path / "x.mcap")], has_dashboard=True)
    assert player.scene is not None
    with page_of(dashboard_of_player(player, player.scene), "127.0.0.1") as page, player:
        assert page.view_url is not None
        caller, viewer, operator = Caller(page.url), cookie_of(page.view_url), cookie_of(page.url)
        assert post(caller, "/api/play", {"is_paused": True}, **viewer)[0] == 403
        assert post(caller, "/api/play", {"is_paused": True}, **operator)[0] == 200
        scenes = [json.loads(caller.ask("GET", "/api/scene", **one)[1]) for one in (viewer, operator)]
        assert [scene["may_play"] for scene in scenes] == [False, True]
        player.stop()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(390, 844), (1280, 900)], ids=["phone", "desktop"])
def test_browser_plays_pauses_and_seeks(recorded: Path, browser: Phone, size: tuple[int, int]) -> None:
    with shown(recorded, loop=True) as (player, url):
        browser.open(url, size)
        says(browser, "#play", "Play")
        browser.tap("#play")
        says(browser, "#state", "playing")
        browser.tap("#play")
        says(browser, "#state", "paused")
        browser.run(
            "(e => { e.value = 0.5 * e.max; e.dispatchEvent(new Event('change')); })"
            "(document.querySelector('#seek'))"
        )
        browser.wait("document.querySelectorAll('#floor .other, #floor .robot').length > 0")
        browser.wait("document.querySelectorAll('#robots tbody tr').length > 0")
        wait_until(lambda: abs(player.position_s - 0.5 * player.duration_s) < 0.5, "the position of the seek")
        browser.run(
            "(e => { e.value = '0.25'; e.dispatchEvent(new Event('change')); })"
            "(document.querySelector('#rate'))"
        )
        says(browser, "#recording", "× 0.25, paused")
        browser.tap("#play")
        says(browser, "#state", "playing × 0.25")
        assert browser.run("document.documentElement.scrollWidth") <= size[0]
        for scheme in ("light", "dark"):
            browser.prefer(scheme)
            assert low_contrasts(browser) == [], scheme
        assert serious_faults(browser) == []
        player.stop()
        says(browser, "#state", "playback ended")
        browser.wait("document.querySelector('#player').hidden")
        assert browser.console == []


@pytest.mark.slow
def test_browser_shows_rate_and_pause(recorded: Path, browser: Phone) -> None:
    with shown(recorded, rate=0.5, loop=True) as (player, url):
        browser.open(url, (1280, 900))
        says(browser, "h1", "Playback")
        says(browser, "#state", "paused")
        player.resume()
        says(browser, "#state", "playing × 0.5")
        says(browser, "#recording", "× 0.5")
        browser.wait("document.querySelectorAll('#floor .other, #floor .robot').length > 0")
        browser.wait("document.querySelectorAll('figure image').length > 0")
        browser.wait("document.querySelector('#operate-panel').hidden")
        player.loop = False
        player.rate = FAST
        says(browser, "#state", "playback ended")
        assert browser.console == []
