"""One thread for linear algebra: the last bits of results depend on the number of threads."""

import json
import os
import subprocess
import sys

import pytest

from ipsys_log.engine.piped_process import ONE_THREAD

# Models are imported within the block, as a command does.
LATE = """
import json
from threadpoolctl import threadpool_info
from ipsys_log.live_runs import pipeline
from ipsys_log.engine.execute import one_blas_thread
with one_blas_thread():
    from ipsys_log.models.table import create
    create("kriging")
    info = [one for one in threadpool_info() if one["user_api"] == "blas"]
print(json.dumps([(one["filepath"], one["num_threads"]) for one in info]))
"""


# A worker process of a replay loads scipy only if its stage needs it.
NEW_PROCESS = """
import json
import scipy.linalg
from threadpoolctl import threadpool_info
info = [one for one in threadpool_info() if one["user_api"] == "blas"]
print(json.dumps([(one["filepath"], one["num_threads"]) for one in info]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("program", "settings"), [(LATE, {}), (NEW_PROCESS, ONE_THREAD)])
def test_libraries_that_are_loaded_late_have_one_thread(program: str, settings: dict[str, str]) -> None:
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**environment, **settings},
        capture_output=True,
        text=True,
        check=True,
    )
    threads = json.loads(done.stdout)
    assert any("scipy" in path for path, _ in threads)
    assert {number for _, number in threads} == {1}
