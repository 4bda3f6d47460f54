"""Run the cases with the code of one commit: ``python -P driver.py PLAN``, with PYTHONPATH at its work tree.

This program imports nothing of the project. It uses only stable names: ``python -m ipsys_log``
with commands and options. Each command runs in a process that is forked from this
one. There the libraries are imported already, and the project is not.
"""

import hashlib
import importlib
import importlib.util
import json
import os
import runpy
import shutil
import signal
import sys
import time
import traceback
from pathlib import Path
from typing import Any

LIBRARIES = (
    *("numpy", "cv2", "scipy.optimize", "scipy.linalg", "scipy.spatial", "scipy.stats", "scipy.interpolate"),
    *("sklearn.base", "sklearn.gaussian_process", "sklearn.pipeline", "sklearn.linear_model"),
    *("mcap.reader", "mcap.writer", "google.protobuf.message_factory", "lz4.frame", "zstandard"),
    *("av", "simplejpeg", "threadpoolctl", "typer", "rich.console", "rich.table", "rich.progress"),
)
HERE = Path(__file__).resolve().parent
LONGEST_S = 600
MODIFIED_S = 1_700_001_000


def main() -> None:
    plan = json.loads(Path(sys.argv[1]).read_text())
    for library in LIBRARIES:
        if importlib.util.find_spec(library.partition(".")[0]) is not None:
            importlib.import_module(library)
    for case in plan["cases"]:
        start_s = time.monotonic()
        done = run_case(case, Path(plan["inputs"]), Path(plan["work"]), plan["tree"])
        done["seconds"] = time.monotonic() - start_s
        print(json.dumps(done), flush=True)  # noqa: T201


def run_case(case: dict[str, Any], inputs: Path, work: Path, tree: str) -> dict[str, Any]:
    """Run the commands of a case in a separate folder; return exit codes and hashes of its files."""
    folder, said = work / case["name"], work / f"{case['name']}.said"
    folder.mkdir(parents=True)
    said.mkdir()
    for name in case["inputs"]:
        if (inputs / name).is_dir():
            shutil.copytree(inputs / name, folder / name)
        else:
            shutil.copy(inputs / name, folder / name)
    for path in folder.rglob("*"):
        os.utime(path, (MODIFIED_S, MODIFIED_S))  # kept by repair
    codes = []
    for number, step in enumerate(case["steps"]):
        out, err = said / f"{number}.out", said / f"{number}.err"
        codes.append(run_command(step["arguments"], step["scripted"], folder, out, err, tree))
        if "--json" in step["arguments"]:
            shutil.copy(out, folder / f"{number}_{step['arguments'][0]}.json")
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    hashes = {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    return {"case": case["name"], "codes": codes, "files": hashes}


def run_command(arguments: list[str], scripted: bool, folder: Path, out: Path, err: Path, tree: str) -> int:
    """Run ``ipsys`` in a forked process; return its exit code, or 124 after the time limit."""
    child = os.fork()
    if child == 0:
        code = 70
        try:
            code = be_ipsys(arguments, scripted, folder, out, err, tree)
        except BaseException:
            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(code)
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return 124


def be_ipsys(arguments: list[str], scripted: bool, folder: Path, out: Path, err: Path, tree: str) -> int:
    os.chdir(folder)
    for path, stream in ((out, 1), (err, 2)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
        os.dup2(file, stream)
        os.close(file)
    if scripted:
        runpy.run_path(str(HERE / "scripted_clock.py"))["install"]()
    found = importlib.util.find_spec("ipsys_log")
    if found is None or not str(found.origin).startswith(tree + os.sep):
        print(f"ipsys_log would come from {found and found.origin}, not from {tree}", file=sys.stderr)  # noqa: T201
        return 70
    sys.argv = ["ipsys", *arguments]
    try:
        runpy.run_module("ipsys_log", run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)  # noqa: T201
            return 1
        return stop.code or 0
    return 0


if __name__ == "__main__":
    main()
