"""The advice on the number of points and on the model, with its reasons."""

import re
from collections.abc import Mapping
from dataclasses import replace

import pytest

from ipsys_log.app.report.advice import ALL_MODELS, HEIGHT_KNOWN, PAPER, SIMPLE, advise
from ipsys_log.app.report.findings import Findings
from ipsys_log.messages import CameraEvaluation, ErrorStatistics, Evaluation, LearningPoint

# half of the 95 % interval of the mean, as a share of the mean
WIDE, NARROW = 0.3, 0.01


def errors(mean_m: float, share: float) -> ErrorStatistics:
    return ErrorStatistics(
        30, mean_m, 0.0, 0.1, 0.01, mean_m, 0.05, mean_m * (1 - share), mean_m * (1 + share)
    )


def evaluation(
    model: str,
    means_cm: Mapping[int, float],
    share: float = NARROW,
    labelled: bool = False,
    level: bool = False,
) -> Evaluation:
    """Return an evaluation with these 3D mean errors by number of points; the 2D errors are half."""
    last_m = means_cm[max(means_cm)] / 100
    space = None if level else errors(last_m, share)
    rows = tuple(
        CameraEvaluation("red", "tape", space, errors(last_m / 2, share), scheme=scheme)
        for scheme in ("held_out", "cross_validation")
    )
    points = tuple(
        LearningPoint("red", n, cm / 100, cm / 200, 1, f"train_{n}")
        if labelled
        else LearningPoint("red", n, cm / 100, cm / 200, 10, std_3d_m=0.0, std_2d_m=0.0)
        for n, cm in means_cm.items()
    )
    return Evaluation(0, model, rows, points)


def test_paper_data_recommend_rigid_with_10_points_poly_from_30(paper: Findings) -> None:
    """Sect. 4.1: the rigid transformation is better than the polynomial with 10 points, and worse later."""
    advice = paper.advice
    assert advice is not None
    assert advice.published
    used = {places: found[SIMPLE].model for places, found in advice.choices.items()}
    assert used[10] == "rigid"
    assert used[30] == used[40] == "poly"
    assert advice.sentences[0].startswith("Between rigid and poly, use rigid with up to ")
    assert "poly from" in advice.sentences[0]


def test_random_subsets_of_the_paper_data_agree(paper: Findings) -> None:
    found = paper.evaluations
    drawn = [replace(e, learning=tuple(p for p in e.learning if p.label is None)) for e in found]
    advice = advise(drawn)
    assert advice is not None
    assert not advice.published
    assert {advice.choices[places][SIMPLE].model for places in (5, 7, 10)} == {"rigid"}
    assert {advice.choices[places][SIMPLE].model for places in (30, 40)} == {"poly"}


def test_the_simplest_model_within_the_noise_is_used() -> None:
    near = {10: 3.0, 20: 2.2}
    alike = advise([evaluation("rigid", near, WIDE), evaluation("poly", {10: 3.0, 20: 2.0}, WIDE)])
    apart = advise([evaluation("rigid", near), evaluation("poly", {10: 3.0, 20: 2.0})])
    assert alike is not None
    assert apart is not None
    assert alike.choices[20][SIMPLE].model == "rigid"
    assert alike.choices[20][SIMPLE].lowest == "poly"
    assert alike.choices[20][SIMPLE].lowest_mean_m == pytest.approx(0.02)
    assert apart.choices[20][SIMPLE].model == "poly"


def test_the_spread_over_random_subsets_is_noise_too() -> None:
    found = [evaluation("rigid", {10: 3.0, 20: 2.2}), evaluation("poly", {10: 3.0, 20: 2.0})]
    spread = [replace(e, learning=tuple(replace(p, std_3d_m=0.01) for p in e.learning)) for e in found]
    advice = advise(spread)
    assert advice is not None
    assert advice.choices[20][SIMPLE].model == "rigid"


def test_labelled_subsets_of_several_sizes_have_priority() -> None:
    labelled = evaluation("rigid", {10: 1.0, 20: 1.0}, labelled=True)
    drawn = evaluation("rigid", {10: 2.0, 15: 2.0})
    both = advise([replace(drawn, learning=(*drawn.learning, *labelled.learning))])
    assert both is not None
    assert both.published
    assert list(both.choices) == [10, 20]
    # One label gives no curve.
    one = advise([replace(drawn, learning=(*drawn.learning, labelled.learning[0]))])
    assert one is not None
    assert not one.published
    assert list(one.choices) == [10, 15]


def test_models_with_known_heights_are_compared_separately() -> None:
    advice = advise(
        [evaluation("rigid", {10: 3.0, 20: 3.0}), evaluation("best", {10: 2.0, 20: 2.0}),
         evaluation("rayplane", {10: 1.0, 20: 1.0})]
    )  # fmt: skip
    assert advice is not None
    assert {group: choice.model for group, choice in advice.choices[10].items()} == {
        SIMPLE: "rigid", PAPER: "rigid", ALL_MODELS: "best", HEIGHT_KNOWN: "rayplane",
    }  # fmt: skip


def test_other_paper_methods_are_not_better_than_rigid_or_poly() -> None:
    advice = advise(
        [evaluation("rigid", {10: 3.0, 20: 3.0}), evaluation("poly", {10: 8.0, 20: 2.4}),
         evaluation("kriging", {10: 2.0, 20: 2.0})]
    )  # fmt: skip
    assert advice is not None
    assert {n: found[SIMPLE].model for n, found in advice.choices.items()} == {10: "rigid", 20: "poly"}
    assert {found[PAPER].model for found in advice.choices.values()} == {"kriging"}
    assert advice.sentences[0] == (
        "Between rigid and poly, use rigid with up to 10 points per camera, poly from 20 on."
    )
    # All methods are the paper's: a column for all would repeat the same.
    assert advice.groups == [SIMPLE, PAPER]


def test_points_at_one_height_are_evaluated_in_2d() -> None:
    advice = advise([evaluation("rigid", {10: 3.0, 20: 3.0}, level=True)])
    assert advice is not None
    assert not advice.in_space
    assert advice.choices[10][SIMPLE].mean_m == pytest.approx(0.015)


def test_mean_curve_needs_the_number_of_points_from_all_cameras() -> None:
    found = evaluation("rigid", {10: 3.0, 20: 3.0, 30: 3.0})
    other = tuple(replace(p, camera="white") for p in found.learning if p.pairs < 30)
    advice = advise([replace(found, learning=(*found.learning, *other))])
    assert advice is not None
    assert list(advice.choices) == [10, 20]


def test_missing_learning_curve_gives_no_advice() -> None:
    assert advise([]) is None
    assert advise([evaluation("rigid", {10: 3.0})]) is None
    assert advise([replace(evaluation("rigid", {10: 3.0}), learning=())]) is None


def test_curve_far_below_the_points_of_a_camera_gives_no_advice() -> None:
    means_cm = {5: 0.5, 7: 0.5}
    assert advise([evaluation("rigid", means_cm), evaluation("poly", means_cm)]) is None


def test_single_model_advice_gives_the_gain_of_more_points() -> None:
    advice = advise([evaluation("best", {10: 3.0, 40: 1.5})])
    assert advice is not None
    assert advice.sentences == (
        "The mean error of best is 3.0 cm with 10 points per camera, 1.5 cm with 40.",
    )


def test_large_error_of_few_points_is_explained(paper: Findings) -> None:
    """With ten points for ten coefficients, the polynomial has tens of centimetres on the paper's data."""
    assert paper.advice is not None
    found = re.fullmatch(
        r"The error of poly with 10 points, (\d+) cm, is no fault of the lab: poly has 10 coefficients for "
        r"each coordinate, so it passes through 10 points with their errors and is wrong between and beyond "
        r"them. With 40 points, it is ([\d.]+) cm.",
        paper.advice.sentences[-1],
    )
    assert found is not None, paper.advice.sentences
    assert int(found[1]) > 20
    assert float(found[2]) < 3
    small = advise([evaluation("rigid", {10: 3.0, 40: 2.0}), evaluation("poly", {10: 3.0, 40: 1.5})])
    assert small is not None
    assert not any("no fault" in sentence for sentence in small.sentences)
