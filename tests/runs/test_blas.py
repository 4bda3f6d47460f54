"""One thread for linear algebra: the last bits of results depend on the number of threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

# Models are imported within the block, as a command does.
LATE = """
import json
from threadpoolctl import threadpool_info
from ipsys_log import pipeline
from ipsys_log.runs.blas import one_blas_thread
with one_blas_thread():
    from ipsys_log.models.table import create
    create("kriging")
    info = [one for one in threadpool_info() if one["user_api"] == "blas"]
print(json.dumps([(one["filepath"], one["num_threads"]) for one in info]))
"""


@pytest.mark.slow
def test_libraries_loaded_within_the_block_have_one_thread() -> None:
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    done = subprocess.run(
        [sys.executable, "-c", LATE], env=environment, capture_output=True, text=True, check=True
    )
    threads = json.loads(done.stdout)
    assert any("scipy" in path for path, _ in threads)
    assert {number for _, number in threads} == {1}
