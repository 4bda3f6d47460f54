"""The output of every stage on a golden log with frames, and its expected hashes and numbers.

    python -m tests.runs.stage_output

writes ``tests/golden/stages/expected.json`` anew: the versions of stages, methods and models, the
environment, and for each channel the hash of its bytes and some of its numbers. A hash that changes without a
higher version is a mistake.
"""

import dataclasses
import hashlib
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ipsys_log.engine.graph import VERSIONS
from ipsys_log.engine.provenance import fingerprint
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.models.table import CORNER_MODELS, MODELS
from ipsys_log.stages.camera_frame import METHODS
from ipsys_log.stages.detect import CORNERS

GOLDEN = Path(__file__).parents[1] / "golden" / "stages"
LOG, EXPECTED = GOLDEN / "frames.mcap", GOLDEN / "expected.json"
# Each corner method and each method of poses once: neither knows of the other.
COMBINATIONS = list(zip(CORNERS, METHODS, strict=True))
_SAMPLES = 4  # number of stored messages per channel
_DIGITS = 9
# Tolerance of the stored numbers (px, m, rad) in another environment, by kind of channel. Corners move by up
# to 0.15 px between OpenCV 4.14 and 5; a neural network moves by more than its inputs.
TOLERANCES = {"markers": 0.2, "camera_points": 0.02, "positions": 0.05, "tracks": 0.05}
# Environments with equal values here give equal bytes.
_RELEVANT = ("numpy", "scipy", "scikit-learn", "opencv-python-headless", "simplejpeg", "machine", "blas")

Channels = dict[str, dict[str, Any]]


def environment() -> dict[str, str]:
    """Return the part of the environment that can change the bytes of a result."""
    return {key: value for key, value in fingerprint().items() if key in _RELEVANT}


def computed(corners: str, method: str) -> Channels:
    """Compute all stages on the golden log with all models, and return the contents of their channels.

    Models are evaluated, and positions are fused, with ``poly`` and with the models of corners only.
    """
    with tempfile.TemporaryDirectory() as folder:
        log = Path(shutil.copy(LOG, folder))
        request = Request(models=(*MODELS, *CORNER_MODELS), corners=corners, method=method)
        pipeline.replay([log], request, "locate")
        pipeline.replay([log], dataclasses.replace(request, models=("poly", *CORNER_MODELS)), "smooth")
        with Session([log]) as session:
            topics = sorted(
                topic
                for reader in session.readers
                for topic in reader.channels
                if topic.startswith("/runs/") and not topic.endswith("/record")
            )
            return {topic: _content(session, topic) for topic in topics if session.count(topic)}


def _content(session: Session, topic: str) -> dict[str, Any]:
    digest, payloads = hashlib.sha256(), []
    for message, data in session.stored([topic]):
        digest.update(f"{message.log_time_ns} {message.publish_time_ns} {len(data)} ".encode() + data)
        payloads.append(message.payload)
    found: dict[str, Any] = {"messages": len(payloads), "sha256": digest.hexdigest()}
    if kind_of(topic) in TOLERANCES:
        chosen = sorted({round(n) for n in np.linspace(0, len(payloads) - 1, _SAMPLES)})
        found["numbers"] = [[round(n, _DIGITS) for n in _numbers(payloads[k])] for k in chosen]
    return found


def kind_of(topic: str) -> str:
    """Return the last part of a topic."""
    return topic.rpartition("/")[2]


def _numbers(value: Any) -> Iterator[float]:
    """Yield the numbers of a payload in the order of its fields, without covariances."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if "covariance" not in field.name:
                yield from _numbers(getattr(value, field.name))
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, np.ndarray):
        yield from map(float, value.ravel())
    elif isinstance(value, float):
        yield value


def main() -> int:
    lines = [f'{{"versions": {json.dumps(VERSIONS)},', f'"environment": {json.dumps(environment())}']
    for corners, method in COMBINATIONS:
        rows = [f"{json.dumps(topic)}: {json.dumps(row)}" for topic, row in computed(corners, method).items()]
        lines[-1] += ","
        lines += [f'"{corners} {method}": {{', ",\n".join(rows), "}"]
    EXPECTED.write_text("\n".join([*lines, "}", ""]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
