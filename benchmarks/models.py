"""Time and accuracy of the models on the authors' 150 calibration points.

    python benchmarks/models.py                  # the time of each step
    python benchmarks/models.py --seeds 10       # also: best against poly on 10 sets of folds

The script needs the public data (docs/data.md). It uses one thread for linear algebra, like the pipeline.
It prints JSON.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from ipsys_log.engine.output import write_log
from ipsys_log.engine.view import LogView
from ipsys_log.exchange.imsel import read_imsel
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Pair
from ipsys_log.messages.channels import CAMERA_POINTS
from ipsys_log.models.table import MODELS
from ipsys_log.statistics.accuracy import error_statistics
from ipsys_log.statistics.calibration_points import build_pairs, gather_sightings, measured
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.statistics.cross_validation import Study, cross_validate, gather_points, labelled_subsets
from ipsys_log.statistics.model_kinds import evaluate_model
from ipsys_log.statistics.tape import RiggedMeasurement

# Best was selected with other folds.
FIRST_SEED = 1000


def read(folder: Path) -> tuple[dict[str, list[Pair]], list[RiggedMeasurement]]:
    with tempfile.TemporaryDirectory() as work:
        log = Path(work) / "imsel.mcap"
        write_log(log, read_imsel(folder))
        with Session([log]) as session:
            places = measured(LogView(session))
            points = gather_sightings(session.messages(session.topics(CAMERA_POINTS, "imsel")))
    return build_pairs(points, places), places


def timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def quiet(done: int, total: int) -> None:
    """Ignore the progress."""


def times(pairs: dict[str, list[Pair]], places: list[RiggedMeasurement]) -> dict[str, object]:
    """Return the seconds of a fit with its uncertainty, and of a full evaluation of each model."""
    measurements = [place.measurement for place in places]
    held_out = {m.id for m in measurements if "test" in m.splits}
    study = Study(places, pairs, held_out, labelled_subsets(measurements), {}, 0)
    fits, studies = {}, {}
    for name in MODELS:
        model = fit_model(name, pairs, 0)
        fits[name] = timed(lambda name=name: fit_model(name, pairs, 0))  # type: ignore[misc]
        studies[name] = timed(lambda model=model: evaluate_model(model, study, 0, [], quiet))  # type: ignore[misc]
        print(f"{name:<26} fit {fits[name]:6.2f} s, study {studies[name]:6.2f} s", file=sys.stderr)
    cameras = gather_points(pairs)
    both = {
        name: timed(lambda name=name: validated(name, cameras, 0))  # type: ignore[misc]
        for name in ("poly", "rayplane")
    }
    return {
        "fit_s": fits,
        "nine_fits_and_rayplane_s": sum(s for name, s in fits.items() if name != "best"),
        "cross_validation_and_bootstrap_s": both,
        "study_s": studies,
        "everything_s": sum(fits.values()) + sum(studies.values()),
    }


def validated(name: str, cameras: dict, seed: int, axes: int = 3) -> float:  # type: ignore[type-arg]
    """Return the mean error in cm over the cameras, by repeated cross-validation."""
    predicted = cross_validate(name, cameras, seed)
    return 100 * float(
        np.mean(
            [
                error_statistics(np.linalg.norm((predicted[c] - places.world_m)[:, :, :axes], axis=2)).mean_m
                for c, places in cameras.items()
            ]
        )
    )


def accuracy(pairs: dict[str, list[Pair]], seeds: int) -> dict[str, object]:
    cameras = gather_points(pairs)
    numbers = range(FIRST_SEED, FIRST_SEED + seeds)
    errors_cm = {name: [validated(name, cameras, seed) for seed in numbers] for name in ("poly", "best")}
    flat = [validated("rayplane", cameras, seed, axes=2) for seed in numbers]
    means = {name: float(np.mean(values)) for name, values in errors_cm.items()}
    return {
        "cross_validated_3d_cm": errors_cm,
        "best_below_poly_percent": 100 * (1 - means["best"] / means["poly"]),
        "rayplane_2d_cm": flat,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=0, help="sets of folds to compare best and poly on")
    options = parser.parse_args()
    data = Path(os.environ.get("IPSYS_DATA", "../shared/data")) / "imsel"
    if not data.is_dir():
        raise SystemExit(f"no real data in {data}: set IPSYS_DATA (docs/data.md says where to get them)")
    pairs, places = read(data)
    with threadpool_limits(1):
        result = times(pairs, places)
        if options.seeds:
            result["accuracy"] = accuracy(pairs, options.seeds)
    json.dump(result, sys.stdout, indent=2)
    print()


if __name__ == "__main__":
    main()
