"""Compare what two commits compute, byte for byte.

    scripts/same-bytes main HEAD                           # all cases, some minutes
    scripts/same-bytes main HEAD --only 'repair-*'         # some cases
    scripts/same-bytes main HEAD --allow allowed.txt       # with differences that are intended

Each commit gets a temporary git work tree and a process that runs the same commands with its code, in one
virtual environment. The tool compares the files that the commands write, their --json output and their exit
codes. It does not compare texts on the screen.

Logs must be equal byte for byte. Recordings have several writing threads, so only the messages of each
topic must be equal, in the order of their log times. New keys in JSON are no difference; the report lists
them.

A line of the allow file is CASE PLACE REASON. CASE and PLACE are patterns of a shell (* is any text). PLACE
is a topic, a path in JSON such as stages.3.run, the name of another file, exit-code, or for a whole log:
order, schemas, bytes. The report names lines that allow nothing.

Nothing is masked. Both commits run with the same environment variables, relative paths and modification times
of input files. They record with a scripted clock. Exit code: 0 equal, 1 different, 2 usage.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from threading import Thread

from tests.same_bytes.allowed import AllowList, AllowListError
from tests.same_bytes.cases import CASES, Case, case_names
from tests.same_bytes.differences import EXIT_CODE, Difference, compare_files, compare_json, compare_logs
from tests.same_bytes.inputs import Inputs, MissingInputError, UnmadeInputError

ROOT = Path(__file__).resolve().parent.parent.parent
DRIVER = Path(__file__).resolve().parent / "driver.py"
_LINES_PER_CASE, _WIDTH = 10, 80
# Other files, such as the bytes that `repair` removes, are compared as bytes.
_LOG = ".mcap"


@dataclass(slots=True)
class Outcome:
    """The result of a case with one commit: exit codes, the hash of each file, and the duration."""

    folder: Path
    codes: list[int]
    files: dict[str, str]
    seconds: float


@dataclass(slots=True)
class CaseResult:
    """The comparison of a case; ``skipped`` is the reason for not running it."""

    case: str
    files: int = 0
    outputs: int = 0
    seconds: tuple[float, float] = (0.0, 0.0)
    differences: list[Difference] = field(default_factory=list)
    allowed: list[Difference] = field(default_factory=list)
    additions: list[str] = field(default_factory=list)
    skipped: str | None = None

    @property
    def state(self) -> str:
        if self.skipped is not None:
            return "skipped"
        if self.differences:
            return "DIFFERENT"
        return "allowed" if self.allowed else "equal"


class Side:
    """One of the two commits: its work tree, and the folders of its commands."""

    def __init__(self, name: str, commit: str, folder: Path) -> None:
        self.name, self.commit, self.folder = name, commit, folder
        self.tree = folder / "tree"
        (folder / "tmp").mkdir(parents=True)

    def run(self, cases: Sequence[Case], inputs: Path, show: Callable[[str], None]) -> dict[str, Outcome]:
        """Run cases in turn in one process."""
        plan = self.folder / "plan.json"
        work = self.folder / "work"
        described = {"inputs": str(inputs), "work": str(work), "tree": str(self.tree)}
        plan.write_text(json.dumps({**described, "cases": [asdict(case) for case in cases]}))
        command = [sys.executable, "-P", str(DRIVER), str(plan)]
        outcomes = {}
        with subprocess.Popen(
            command, env=self._environment(), cwd=self.folder, stdout=subprocess.PIPE, text=True
        ) as process:
            for line in process.stdout or ():
                done = json.loads(line)
                folder = work / done["case"]
                outcomes[done["case"]] = Outcome(folder, done["codes"], done["files"], done["seconds"])
                show(f"{self.name}  {done['case']:<28} {done['seconds']:6.1f} s")
        return outcomes

    def _environment(self) -> dict[str, str]:
        kept = {name: os.environ[name] for name in ("PATH", "HOME", "LD_LIBRARY_PATH") if name in os.environ}
        return {
            **kept,
            "PYTHONPATH": str(self.tree),
            "TMPDIR": str(self.folder / "tmp"),
            "PYTHONHASHSEED": "0",
            "OPENBLAS_NUM_THREADS": "1",
            "SOURCE_DATE_EPOCH": "1700000000",
            "LC_ALL": "C.UTF-8",
            "TZ": "UTC",
            "COLUMNS": str(_WIDTH),
            "NO_COLOR": "1",
        }


def compare_case(case: Case, old: Outcome, new: Outcome, allowed: AllowList) -> CaseResult:
    """Compare the exit codes, files and JSON of a case."""
    result = CaseResult(case.name, seconds=(old.seconds, new.seconds))
    found = list(_compare_codes(case, old, new))
    # Logs come first, because the printed output follows from them.
    for name in sorted({*old.files, *new.files}, key=lambda name: (not name.endswith(_LOG), name)):
        result.files += 1
        if old.files.get(name) == new.files.get(name):
            result.outputs += name.endswith(".json")
        elif name not in old.files or name not in new.files:
            found.append(Difference(name, f"only {'old' if name in old.files else 'new'} writes it"))
        else:
            paths = old.folder / name, new.folder / name
            differences = _compare_file(name, *paths, case.messages_only, result)
            found += [replace(one, file=name) for one in differences]
    for difference in found:
        (result.allowed if allowed.allows(case.name, difference) else result.differences).append(difference)
    return result


def _compare_codes(case: Case, old: Outcome, new: Outcome) -> Iterator[Difference]:
    for number, (step, *codes) in enumerate(zip(case.steps, old.codes, new.codes, strict=True)):
        command = " ".join(step.arguments[:2])
        if codes[0] != codes[1]:
            yield Difference(EXIT_CODE, f"{command}: {codes[0]} -> {codes[1]}{_said(new, number)}")
        elif codes[0] not in step.codes:
            # Equal errors prove nothing.
            yield Difference(EXIT_CODE, f"{command}: fails with both, {codes[0]}{_said(new, number)}")


def _said(outcome: Outcome, number: int) -> str:
    path = outcome.folder.with_name(f"{outcome.folder.name}.said") / f"{number}.err"
    lines = path.read_text(errors="replace").split("\n") if path.is_file() else []
    last = next((line for line in reversed(lines) if line.strip()), "")
    return f"; {last}" if last else ""


def _compare_file(
    name: str, old: Path, new: Path, messages_only: bool, result: CaseResult
) -> list[Difference]:
    if name.endswith(_LOG):
        return compare_logs(old, new, messages_only)
    if not name.endswith(".json"):
        return compare_files(old, new, name)
    result.outputs += 1
    try:
        values = json.loads(old.read_text()), json.loads(new.read_text())
    except ValueError:
        return compare_files(old, new, name)
    found = compare_json(*values)
    result.additions += [f"{name}: {path}" for path in found.additions]
    if not found.differences and not found.additions:
        return [Difference(name, "equal values, written in another way")]
    return found.differences


def report_lines(
    results: Sequence[CaseResult], commits: tuple[str, str], seconds: float, unused: Sequence[str]
) -> Iterator[str]:
    """Return the result, the table, and at most ten lines of differences per case."""
    states = [result.state for result in results]
    different, ran = states.count("DIFFERENT"), len(states) - states.count("skipped")
    files = sum(result.files for result in results)
    answer = f"equal: {ran} cases, {files} files" if ran else "nothing compared"
    if different:
        answer = f"DIFFERENT: {different} of {ran} cases"
    notes = [f"{states.count(name)} {name}" for name in ("allowed", "skipped") if name in states]
    yield f"{answer}; {commits[0][:10]} -> {commits[1][:10]}; {', '.join([*notes, f'{seconds:.0f} s'])}"
    yield ""
    yield f"{'case':<30}{'files':>6}{'JSON':>6}{'old s':>9}{'new s':>9}  result"
    for one in results:
        times = "".join(f"{value:>9.1f}" for value in one.seconds)
        yield f"{one.case:<30}{one.files:>6}{one.outputs:>6}{times}  {one.state}"
    for one in results:
        yield from _details(one)
    if unused:
        yield from ("", *unused)


def _details(result: CaseResult) -> Iterator[str]:
    lines = [] if result.skipped is None else [result.skipped]
    lines += map(str, _first_of_each_file(result.differences))
    lines += [f"allowed: {one}" for one in _first_of_each_file(result.allowed)]
    lines += [f"new key: {one}" for one in result.additions]
    if lines:
        yield from ("", result.case)
    if len(lines) > _LINES_PER_CASE:
        lines = [*lines[: _LINES_PER_CASE - 1], f"and {len(lines) - _LINES_PER_CASE + 1} more"]
    yield from (f"  {line}" for line in lines)


def _first_of_each_file(differences: Sequence[Difference]) -> list[Difference]:
    """Return the differences in order: the first of each file, then the second of each.

    The first of each file, then the second of each, so that no file hides the others.
    """
    counts: Counter[str] = Counter()
    ranks = []
    for one in differences:
        ranks.append(counts[one.file])
        counts[one.file] += 1
    return [one for _, one in sorted(zip(ranks, differences, strict=True), key=lambda pair: pair[0])]


def _as_json(results: Sequence[CaseResult], commits: tuple[str, str], unused: Sequence[str]) -> str:
    cases = [{**asdict(result), "state": result.state} for result in results]
    equal = not any(result.differences for result in results)
    report = {"equal": equal, "old": commits[0], "new": commits[1], "cases": cases, "unused": list(unused)}
    return json.dumps(report, indent=2)


@contextmanager
def _worktrees(sides: Sequence[Side]) -> Iterator[None]:
    """Create a work tree of each commit for the duration of the block."""
    try:
        for side in sides:
            _git("worktree", "add", "--detach", "--force", str(side.tree), side.commit)
        yield
    finally:
        for side in sides:
            if side.tree.exists():
                _git("worktree", "remove", "--force", str(side.tree))


def _commit(name: str) -> str:
    return _git("rev-parse", "--verify", f"{name}^{{commit}}")


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", "-C", str(ROOT), *arguments], check=True, capture_output=True, text=True
    ).stdout.strip()


def _compare(
    cases: Sequence[Case], sides: tuple[Side, Side], folder: Path, allowed: AllowList, at_once: int
) -> list[CaseResult]:
    def show(line: str) -> None:
        print(line, file=sys.stderr, flush=True)  # noqa: T201

    def prepare(case: Case) -> Path:
        sides[0].run([case], inputs.folder, show)
        return sides[0].folder / "work" / case.name

    inputs = Inputs(folder / "inputs", sides[0].tree, prepare)
    inputs.folder.mkdir()
    unready: dict[str, CaseResult] = {}
    for case in cases:
        try:
            inputs.make(case.inputs)
        except MissingInputError as error:
            unready[case.name] = CaseResult(case.name, skipped=str(error))
        except UnmadeInputError as error:
            unready[case.name] = CaseResult(case.name, differences=[Difference("inputs", str(error))])
    ready = [case for case in cases if case.name not in unready]
    outcomes: dict[str, Mapping[str, Outcome]] = {}

    def run(side: Side) -> None:
        outcomes[side.name] = side.run(ready, inputs.folder, show)

    threads = [Thread(target=run, args=(side,)) for side in sides]
    for n, thread in enumerate(threads):
        thread.start()
        if at_once == 1 or n == len(threads) - 1:
            thread.join()
    threads[0].join()
    return [unready.get(case.name) or _result(case, outcomes, allowed) for case in cases]


def _result(case: Case, outcomes: Mapping[str, Mapping[str, Outcome]], allowed: AllowList) -> CaseResult:
    sides = [outcomes.get(name, {}).get(case.name) for name in ("old", "new")]
    if sides[0] is None or sides[1] is None:
        ended = Difference(EXIT_CODE, "the process of a commit ended early")
        return CaseResult(case.name, differences=[ended])
    return compare_case(case, sides[0], sides[1], allowed)


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    described, _, rest = str(__doc__).partition("\n")
    parser = argparse.ArgumentParser(
        "same-bytes", description=described, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old", metavar="OLD", help="a commit: a hash, a branch, HEAD~3")
    parser.add_argument("new", metavar="NEW", help="the commit to compare with it")
    parser.add_argument("--allow", type=Path, metavar="FILE", help="differences that are allowed")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only these cases; patterns as of a shell")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.add_argument("--jobs", type=int, choices=(1, 2), default=2, help="commits at once (default: 2)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep all files in this new folder")
    options = parser.parse_args(arguments)
    try:
        options.commits = tuple(map(_commit, (options.old, options.new)))
        options.allowed = AllowList.read(options.allow) if options.allow else AllowList()
    except subprocess.CalledProcessError as error:
        parser.error(f"{error.cmd[-1].partition('^')[0]}: no such commit")
    except (AllowListError, OSError) as error:
        parser.error(str(error))
    for pattern in options.only or ():
        if not any(fnmatchcase(name, pattern) for name in case_names()):
            parser.error(f"--only {pattern}: no such case; there are: {', '.join(case_names())}")
    if options.keep is not None and options.keep.exists():
        parser.error(f"--keep {options.keep}: exists already")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare two commits, print the report, and return the exit code."""
    options = _options(sys.argv[1:] if arguments is None else arguments)
    wanted: list[str] = options.only or ["*"]
    cases = [case for case in CASES if any(fnmatchcase(case.name, pattern) for pattern in wanted)]
    if not sys.platform.startswith("linux"):
        cases = [case for case in cases if not any(step.scripted for step in case.steps)]
        print("record and live are not compared: their scripted clock needs Linux", file=sys.stderr)  # noqa: T201
    start_s = time.monotonic()
    with _folder(options.keep) as folder:
        sides = tuple(
            Side(name, commit, folder / name)
            for name, commit in zip(("old", "new"), options.commits, strict=True)
        )
        with _worktrees(sides):
            results = _compare(cases, (sides[0], sides[1]), folder, options.allowed, options.jobs)
    unused = options.allowed.unused([case.name for case in cases])
    if options.json:
        print(_as_json(results, options.commits, unused))  # noqa: T201
    else:
        for line in report_lines(results, options.commits, time.monotonic() - start_s, unused):
            print(_fitting(line))  # noqa: T201
    if all(result.skipped is not None for result in results):
        return 2
    return 1 if any(result.differences for result in results) else 0


def _fitting(line: str) -> str:
    """Return a line of at most 80 columns; continuation lines are indented."""
    import textwrap

    if len(line) <= _WIDTH:
        return line
    return textwrap.fill(line, _WIDTH, subsequent_indent="      ", break_on_hyphens=False)


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True)
        yield keep.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="same-bytes-", dir=os.environ.get("TMPDIR")) as folder:
        yield Path(folder).resolve()


if __name__ == "__main__":
    sys.exit(main())
