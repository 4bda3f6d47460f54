"""Many cases of the fuzz job: ``python -m tests.fuzz.many [COUNT [TARGET ...]]``.

The first failure of each target is shrunk and shown; the job goes on with the next target.
"""

import sys
import time
import traceback

from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings

from tests.fuzz.targets import TARGETS, attack

_DEFAULT = 200_000


def main() -> int:
    """Share the cases among the targets; return 1 if one of them fails."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else _DEFAULT
    names = sys.argv[2:] or list(TARGETS)
    failed = 0
    for name in names:
        start_s = time.monotonic()
        cases, fault = _run(name, count // len(names))
        failed += fault
        state = "FAILED" if fault else "passed"
        print(f"{name:<8} {cases} cases {state} in {time.monotonic() - start_s:.0f} s", flush=True)  # noqa: T201
    return 1 if failed else 0


def _run(name: str, count: int) -> tuple[int, bool]:
    strategy, act = TARGETS[name]()
    cases = 0

    @seed(time.time_ns())
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
        verbosity=Verbosity.normal,
    )
    @given(strategy)
    def run(given: object) -> None:
        nonlocal cases
        cases += 1
        attack(act, given)

    try:
        run()
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        traceback.print_exc()
        return cases, True
    return cases, False


if __name__ == "__main__":
    sys.exit(main())
