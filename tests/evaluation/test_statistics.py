import numpy as np
import pytest

from mbagent.evaluation.statistics import interquartile_interval, interquartile_mean, normalised, ratio_interval


def test_random_play_is_zero_and_the_reference_is_one() -> None:
    assert normalised([10.0, 30.0, 20.0], random=10.0, reference=30.0).tolist() == [0.0, 1.0, 0.5]


@pytest.mark.parametrize("reference", [1.0, 0.5, float("nan")])
def test_a_reference_that_does_not_beat_random_play_is_refused(reference: float) -> None:
    with pytest.raises(ValueError, match="has to beat random play"):
        normalised([1.0], random=1.0, reference=reference)


def test_interquartile_mean_drops_a_quarter_at_each_end() -> None:
    assert interquartile_mean([-1000.0, 1.0, 3.0, 1000.0]) == 2.0
    assert interquartile_mean([-1000.0, 1.0, 2.0, 3.0, 1000.0]) == 2.0
    assert interquartile_mean([1.0, 2.0, 6.0]) == 3.0  # too few to trim
    assert interquartile_mean(np.arange(24.0).reshape(2, 3, 4)).shape == (2, 3)
    with pytest.raises(ValueError, match="at least one value"):
        interquartile_mean([])


def test_the_interval_is_reproducible_and_holds_the_estimate() -> None:
    scores = np.random.default_rng(1).normal(size=(5, 20))
    first, second = interquartile_interval(scores, seed=3), interquartile_interval(scores, seed=3)
    assert first == second
    assert first.low < first.estimate < first.high


def test_the_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    # Between-run spread 1, within-run spread 1: few runs make percentile bootstraps a little narrow.
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        scores = rng.normal(size=(8, 1)) + rng.normal(size=(8, 10))
        interval = interquartile_interval(scores, resamples=300)
        covered += interval.low <= 0 <= interval.high
    assert 0.85 <= covered / 200 <= 0.99


def test_equal_scores_leave_no_width_and_one_run_shows_the_luck_of_episodes() -> None:
    assert interquartile_interval(np.full((3, 4), 0.7)).high == pytest.approx(0.7)
    single = interquartile_interval([[0.0, 1.0, 0.0, 1.0]])
    assert single.low < single.estimate == 0.5 < single.high


def test_one_outlying_run_of_five_does_not_move_the_estimate() -> None:
    scores = np.ones((5, 10))
    scores[2] = -50
    assert interquartile_interval(scores).estimate == 1.0


def test_shapes_other_than_runs_by_episodes_are_refused() -> None:
    for wrong in ([1.0, 2.0], np.zeros((0, 5)), np.zeros((2, 0))):
        with pytest.raises(ValueError, match="runs, episodes"):
            interquartile_interval(wrong)
    with pytest.raises(ValueError, match="between 0 and 1"):
        interquartile_interval([[1.0]], confidence=95)


def test_a_ratio_compares_plain_means_and_resamples_both_sides_together() -> None:
    others = np.random.default_rng(2).normal(10.0, 3.0, size=(5, 20))
    half = ratio_interval(1.0 + (others - 1.0) / 2.0, others, zero=1.0)
    assert half.estimate == pytest.approx(0.5)
    assert half.high - half.low < 1e-12  # both share the random numbers of the episodes, so the width is zero
    bad_run = others.copy()
    bad_run[0] = 1.0
    assert ratio_interval(bad_run, others, zero=1.0).estimate == pytest.approx((bad_run - 1).sum() / (others - 1).sum())
    with pytest.raises(ValueError, match="same shape"):
        ratio_interval(others, others[:3], zero=1.0)
    with pytest.raises(ValueError, match="above zero"):
        ratio_interval(others, others, zero=50.0)
