"""Versions of stages: results of older software are recognised, and computed again beside them."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.engine import provenance
from ipsys_log.engine.graph import STAGES, VERSIONS, version_parameters
from ipsys_log.engine.provenance import recorded_version
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.models.table import CORNER_MODELS, MODELS
from ipsys_log.stages.camera_frame import METHODS
from ipsys_log.stages.detect import CORNERS
from tests.conftest import ROOT, Ipsys
from tests.tiers import first_fast

Rows = dict[tuple[str, str], dict[str, Any]]


@pytest.fixture
def log(replayed_lab: Path) -> Path:
    """A copy of a log with all stages up to fuse."""
    return replayed_lab


def states(ipsys: Ipsys, log: Path) -> Rows:
    done = ipsys("runs", log, "--json")
    assert done.code == 0, done.err
    return {(row["run"], row["stage"]): row for row in json.loads(done.out)["rows"]}


def made(ipsys: Ipsys, *arguments: object) -> dict[str, tuple[str, bool]]:
    done = ipsys("replay", *arguments, "--json")
    assert done.code == 0, done.err
    return {row["stage"]: (row["run"], row["new"]) for row in json.loads(done.out)["stages"]}


def test_everything_that_computes_has_a_version() -> None:
    parts = {part for model in (*MODELS, *CORNER_MODELS) for part in model.split("+")}
    assert VERSIONS.keys() == {*(stage.name for stage in STAGES), *CORNERS, *METHODS, *parts}
    assert min(VERSIONS.values()) >= 1


def test_version_is_named_from_the_second_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(VERSIONS, "kriging", 1)
    assert version_parameters("fit", "rigid+kriging") == {}
    monkeypatch.setitem(VERSIONS, "kriging", 3)
    assert version_parameters("fit", "rigid+kriging") == {"kriging": "3"}
    assert version_parameters("camera-frame") == {}


def test_current_runs_are_found_again(ipsys: Ipsys, log: Path) -> None:
    rows = states(ipsys, log)
    assert {row["state"] for row in rows.values()} == {"current"}
    assert all(row["stage_version"] == VERSIONS[stage] for (_, stage), row in rows.items())
    assert not any(row["out_of_date"] for row in rows.values())
    assert not any(new for _, new in made(ipsys, log).values())


@pytest.mark.parametrize("changed", ["detect", "edges"])
def test_changed_stage_is_done_again_beside_the_old_run(
    changed: str, ipsys: Ipsys, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = VERSIONS[changed]
    monkeypatch.setitem(VERSIONS, changed, before + 1)
    rows = states(ipsys, log)
    reason = f"out of date: made by {changed} {before}, this is {changed} {before + 1}"
    assert rows["edges", "detect"]["state"] == reason
    assert rows["edges", "camera-frame"]["state"] == "out of date: input edges is"
    assert rows["poly", "fuse"]["state"] == "out of date: input poly is"
    assert all(row["out_of_date"] for row in rows.values())
    done = ipsys("replay", log)
    assert done.code == 0
    with Session([log]) as session:
        frames = sum(session.count(topic) for topic in session.images.values())
    assert f"detect is computed again for {frames} frames; run edges is {reason}" in done.err
    rows = states(ipsys, log)
    assert rows["edges_2", "detect"]["parameters"][changed] == str(before + 1)
    assert rows["edges_2", "detect"]["stage_version"] == VERSIONS["detect"]
    assert rows["poly_2", "fuse"]["state"] == "current"
    assert rows["poly", "fuse"]["out_of_date"]
    assert not any(new for _, new in made(ipsys, log).values())


@pytest.mark.parametrize(
    "changed", first_fast(3, ["camera-frame", "perimeter", "fit", "evaluate", "locate", "fuse"])
)
def test_replay_leaves_its_runs_current(
    changed: str, ipsys: Ipsys, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(VERSIONS, changed, VERSIONS[changed] + 1)
    before = states(ipsys, log)
    used = made(ipsys, log)
    rows = states(ipsys, log)
    assert {rows[run, stage]["state"] for stage, (run, _) in used.items()} == {"current"}
    assert not any(new for _, new in made(ipsys, log).values())
    # Exactly the results that were out of date are computed again.
    assert {stage for (_, stage), row in before.items() if row["out_of_date"]} == {
        stage for stage, (_, new) in used.items() if new
    }


def test_name_of_a_run_that_is_out_of_date_is_refused_first(
    ipsys: Ipsys, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made(ipsys, log, "--run", "mine")
    monkeypatch.setitem(VERSIONS, "detect", VERSIONS["detect"] + 1)
    before = log.read_bytes()
    done = ipsys("replay", log, "--run", "mine")
    assert done.code == 1
    assert "run mine already has the stage fit, which is out of date: input edges is; use another" in done.err
    assert log.read_bytes() == before


def test_stages_that_are_not_known_here_are_left_alone(ipsys: Ipsys, log: Path) -> None:
    from ipsys_log.engine.output import append_messages
    from ipsys_log.messages import Message, Run

    with Session([log]) as session:
        time_ns = session.end_ns + 1
    run = Run(time_ns, "poly", "damp", input_runs=("poly",), number=99)
    append_messages(log, [Message("/runs/poly/record", time_ns, time_ns, run)])
    state = "made by damp 1, which is not known here: update ipsys"
    assert states(ipsys, log)["poly", "damp"]["state"] == state
    done = ipsys("verify", log)
    assert (done.code, state in done.err) == (0, True)


@pytest.mark.slow
def test_state_does_not_depend_on_the_order_of_logs(
    ipsys: Ipsys, lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, last = tmp_path / "first.mcap", tmp_path / "last.mcap"
    assert ipsys("camera-frame", lab, "-o", first).code == 0
    assert ipsys("replay", lab, first, "-o", last, "--model", "poly").code == 0
    assert ipsys("verify", last, first, lab).code == 0
    monkeypatch.setitem(VERSIONS, "perimeter", VERSIONS["perimeter"] + 1)
    found = [
        {
            (row["run"], row["stage"]): row["state"]
            for row in json.loads(ipsys("runs", *logs, "--json").out)["rows"]
        }
        for logs in ((lab, first, last), (last, first, lab))
    ]
    assert found[0] == found[1]
    assert found[0]["poly", "fuse"] == "out of date: input poly is"


def test_run_of_newer_software_is_never_replaced(
    ipsys: Ipsys, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as newer:
        newer.setitem(VERSIONS, "detect", 4)
        made(ipsys, log)
    before = log.read_bytes()
    done = ipsys("replay", log)
    assert done.code == 1
    assert "run edges_2, stage detect: made by detect 4, this is detect 3: update ipsys" in done.err
    assert log.read_bytes() == before
    assert states(ipsys, log)["edges_2", "detect"]["out_of_date"] is False


def test_verify_names_results_of_other_versions(
    ipsys: Ipsys, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(VERSIONS, "detect", 4)
    done = ipsys("verify", log)
    assert done.code == 0, done.out
    assert (
        "run edges: detect is out of date: made by detect 3, this is detect 4; it is not verified" in done.err
    )
    assert "/runs/poly/tracks" in ipsys("verify", log, "--json").out
    for name in (stage.name for stage in STAGES):
        monkeypatch.setitem(VERSIONS, name, VERSIONS[name] + 1)
    done = ipsys("verify", log)
    assert done.code == 1
    assert "has no run that can be verified" in done.err


def test_package_versions_do_not_outdate_runs(
    ipsys: Ipsys, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provenance, "_versions", lambda: (("ipsys_log", "99.0"), ("numpy", "99.0")))
    assert not any(new for _, new in made(ipsys, log).values())


def test_measurement_since_makes_the_model_out_of_date(ipsys: Ipsys, log: Path, tmp_path: Path) -> None:
    from ipsys_log.engine.output import append_messages
    from ipsys_log.live_runs.survey.checks import withdrawal_of
    from ipsys_log.messages import Message

    with Session([log]) as session:
        last, time_ns = session.payloads(["/measurements"])[-1], session.end_ns + 1
    append_messages(log, [Message("/measurements", time_ns, time_ns, withdrawal_of([last], last.id))])
    rows = states(ipsys, log)
    assert rows["edges", "camera-frame"]["state"] == "current"
    assert rows["poly", "fit"]["state"] == "out of date: measurements changed"
    assert rows["poly", "fuse"]["state"] == "out of date: input poly is"
    done = ipsys("view", log, "--save", tmp_path / "a.rrd")
    assert "run poly: fit is out of date: measurements changed; ipsys replay computes it again" in done.err
    assert "fit is computed again; run poly is out of date: measurements changed" in ipsys("replay", log).err


@pytest.mark.slow
def test_run_without_its_inputs_is_not_repeatable(ipsys: Ipsys, tmp_path: Path) -> None:
    log = Path(shutil.copy(ROOT / "sample_logs" / "paper_lab.mcap", tmp_path / "paper.mcap"))
    first = states(ipsys, log)
    assert first
    assert {row["state"] for row in first.values()} == {"not repeatable"}
    assert made(ipsys, log, "--model", "poly")["fuse"] == ("poly", True)
    assert states(ipsys, log)["poly", "fuse"]["state"] == "current"
    done = ipsys("verify", log)
    assert (done.code, "detect is not verified: its input /cameras/" in done.err) == (0, True)
    assert "/runs/poly/tracks" in ipsys("verify", log, "--json").out


def test_unfinished_run_has_the_state_unfinished(ipsys: Ipsys, log: Path, tmp_path: Path) -> None:
    short = tmp_path / "short.mcap"
    with Session([log]) as session, LogWriter.create(short) as writer:
        from ipsys_log.engine.output import write_message

        left = 3
        for message in session.messages({t for reader in session.readers for t in reader.channels}):
            if message.topic == "/runs/poly/tracks":
                left -= 1
                if left < 0:
                    continue
            write_message(writer, message, {})
    assert states(ipsys, short)["poly", "fuse"]["state"] == "unfinished"


@pytest.mark.parametrize("text", ["", "two", "-1", "9" * 5000, "²"])
def test_senseless_version_in_a_log_counts_as_the_first(text: str) -> None:
    from ipsys_log.messages import Run

    assert recorded_version(Run(0, "a", "detect", parameters={"detect": text}), "detect") == 1
