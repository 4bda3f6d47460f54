"""Mistakes of the first day: the message names the fault and the next step, and nothing is half-written."""

import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import Ipsys


class Mistake(NamedTuple):
    """A command with a mistake; ``fault`` and ``step`` are parts of the message.

    ``rig`` is a change of the rig file. The files are lab.mcap (recording), cal.mcap (with a model), and
    lab.toml (the simulated lab).
    """

    command: str
    fault: str
    step: str
    rig: tuple[str, str] = ("", "")


SIDE = "marker_length_m = 0.2"
MISTAKES = {
    # Names that are mistyped or missing.
    "command": Mistake("repaly lab.mcap", "No such command 'repaly'", "Did you mean 'replay'"),
    "option": Mistake("replay lab.mcap --modle poly", "No such option: --modle", "--model"),
    "model": Mistake("replay lab.mcap --model polly", "model 'polly' is not known", "use one of rigid, poly"),
    "stage": Mistake("replay lab.mcap --until fite", "is not a stage", "use one of detect"),
    "log": Mistake("replay lb.mcap", "lb.mcap does not exist", "in this folder: cal.mcap, lab.mcap"),
    "rig_for_log": Mistake("replay lab.toml", "is not an MCAP file", "give a log"),
    "no_rig": Mistake("record --rig lb.toml -o a.mcap", "lb.toml: does not exist", "ipsys init lb.toml"),
    "no_output": Mistake("export cal.mcap", "-o is missing", "-o NAME.csv"),
    "no_model": Mistake("live --rig lab.toml -o a.mcap", "--model-from", "ipsys calibrate-lab"),
    "log_without_model": Mistake(
        "live --rig lab.toml -o a.mcap --model-from lab.mcap", "has no fitted model", "ipsys replay lab.mcap"
    ),
    "board": Mistake("calibrate lab.mcap --board 5x", "--board 5x: is not a board", "as 6x4"),
    "point": Mistake("exclude lab.mcap p999", "has no calibration point 'p999'", "it has s000"),
    "seconds": Mistake("record --rig lab.toml -o a.mcap --seconds 0", "'--seconds'", "equal to 0.1"),
    "label": Mistake("replay lab.mcap --train half", "has the label 'half'", "use --train"),
    "table": Mistake("export cal.mcap -o a.xyz", "a.xyz", ".csv"),
    "figure": Mistake("plan lab.mcap --plot floor.doc", "is not a figure file", "ends in .png, .pdf, .svg"),
    # Files that would be lost.
    "new_log": Mistake("record --rig lab.toml -o lab.mcap", "exists already", "another name, or --force"),
    "new_rig": Mistake("init lab.toml", "lab.toml: exists already", "edit it, or give another name"),
    "folder": Mistake("record --rig lab.toml -o x/a.mcap", "there is no folder x", "make it first"),
    # Values in another unit, and values of another print.
    "side_cm": Mistake(
        "record --rig lab.toml -o a.mcap", "20 is too large", "write 0.2", (SIDE, "marker_length_m = 20")
    ),
    "decimal_comma": Mistake("replay lab.mcap --rig lab.toml", "0,2", "0.2", (SIDE, "marker_length_m = 0,2")),
    "dictionary": Mistake(
        "replay lab.mcap --rig lab.toml", "the prints are of DICT_4X4", 'write dictionary = "DICT_4X4',
        ("DICT_4X4_100", "DICT_5X5_100"),
    ),
    "twice": Mistake(
        "replay lab.mcap --rig lab.toml", "two markers have the id 1", "give each its own",
        ("id = 0\n", "id = 1\n"),
    ),
    "height": Mistake(
        "replay lab.mcap --rig lab.toml --model rayplane", "the height of marker", "write marker_height_m",
        ("marker_height_m = 0.1\n", ""),
    ),
    "sheet_m": Mistake("measure lab.mcap --csv sheet.csv", "2.233 cm looks like metres", "type 223.3"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_named_with_the_next_step(
    name: str, ipsys: Ipsys, lab_log: Path, calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert ipsys("init", "lab.toml", "--simulated").code == 0
    rig, (before, after) = tmp_path / "lab.toml", MISTAKES[name].rig
    rig.write_text(rig.read_text().replace(before, after, 1))
    shutil.copy(lab_log, "lab.mcap")
    shutil.copy(calibration, "cal.mcap")
    (tmp_path / "sheet.csv").write_text("marker,d_A_cm,d_B_cm,side,height_cm\n3,2.233,110.0,left,0\n")
    files = {path: path.read_bytes() for path in tmp_path.iterdir()}
    done = ipsys(*MISTAKES[name].command.split())
    assert done.code in (1, 2)  # 2: the words are no command
    message = " ".join(done.err.replace("│", " ").split())
    assert MISTAKES[name].fault in message
    assert MISTAKES[name].step in message
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == files
