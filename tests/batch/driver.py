"""Program for the tests of batches: run a work of the tests on logs, with local or other workers.

It is a separate process, so that no thread or socket of Dask stays in the process of the tests. Its argument
is JSON; it prints the results as JSON, or the error.
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ipsys_log.api.batch import tasks
from ipsys_log.api.batch.execution import run_batch
from ipsys_log.api.batch.workers import WorkerSettings, open_workers
from ipsys_log.errors import IpsysError
from tests.batch.piece_works import compute_and_note, replay_pieces
from tests.batch.works import PATIENCE_S, replay_and_note


def main(text: str) -> None:
    request = json.loads(text)
    logs = [Path(log) for log in request["logs"]]
    given: dict[str, Any] = request["workers"]
    settings = WorkerSettings(
        scheduler=given.get("scheduler"),
        workers=given.get("workers"),
        tls_ca=_path(given.get("tls_ca")),
        tls_cert=_path(given.get("tls_cert")),
        tls_key=_path(given.get("tls_key")),
    )
    try:
        with open_workers(settings, request.get("tasks", len(logs))) as workers:
            workers.client.wait_for_workers(1, timeout=PATIENCE_S)
            task = tasks.BatchTask(replay_and_note, {"notes": Path(request["notes"])})
            if request.get("pieces"):
                task = tasks.BatchTask(replay_pieces, divides=True)
                vars(tasks)["compute_alone"] = compute_and_note
            results = [asdict(result) for result in run_batch(workers, task, logs)]
    except IpsysError as error:
        sys.stdout.write(json.dumps({"error": str(error)}))
        return
    sys.stdout.write(json.dumps({"results": results}))


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)


if __name__ == "__main__":
    main(sys.argv[1])
