"""Summary of the scores of single data sets: the tables, and checks of the paper's conclusions (section 3.4)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from mbagent.evaluation.report import Table
from mbagent.evaluation.statistics import Interval, mean_interval
from studies.sampling_accuracy.experiment import FEW_ITERATIONS
from studies.sampling_accuracy.samplers import CAUSAL, COMBINED, PREDICTOR
from studies.sampling_accuracy.scores import Draws, Score
from studies.sampling_accuracy.trials import TRIALS, Trial

MEASURES: dict[str, str] = {
    "union": "Pearson, union",
    "seen": "Pearson, observed",
    "full": "Pearson, all outcomes",
    "variation": "Total variation",
    "valid": "Valid mass",
    "log_likelihood": "Log-likelihood",
}
"""Columns of the table: field of a score and title."""


@dataclass(frozen=True)
class Cell:
    """A measure over seeds.

    Attributes:
        interval: mean with its 95% t interval, over the seeds for which it is defined; NaN if there are none.
        undefined: number of seeds for which it is undefined.
    """

    interval: Interval
    undefined: int


@dataclass(frozen=True)
class Line:
    """One sampler's row in the table of a trial."""

    sampler: str
    draws: Draws
    cells: dict[str, Cell]
    parameters: int
    fit_seconds: float
    sample_microseconds: float
    seeds: int


@dataclass(frozen=True)
class Statement:
    """One of the paper's conclusions, checked.

    Attributes:
        text: the conclusion.
        evidence: the results on which the check is based.
        holds: whether they support it; None if an interval leaves it open, or a result is undefined.
    """

    text: str
    evidence: str
    holds: bool | None


def cell(values: Iterable[float]) -> Cell:
    """Mean and interval over seeds; NaN values are counted, not averaged."""
    given = list(values)
    return Cell(mean_interval(given), int(np.isnan(given).sum()))


def table(scores: Sequence[Score], trial: Trial) -> list[Line]:
    """The rows of a trial, in the order in which samplers were measured."""
    mine = [score for score in scores if score.trial == trial.name]
    lines = []
    for sampler, draws in dict.fromkeys((score.sampler, score.draws) for score in mine):
        group = [score for score in mine if (score.sampler, score.draws) == (sampler, draws)]
        lines.append(
            Line(
                sampler,
                draws,
                {name: cell(getattr(score, name) for score in group) for name in MEASURES},
                group[0].parameters,
                float(np.mean([score.fit_seconds for score in group])),
                float(np.median([score.sample_microseconds for score in group])),
                len(group),
            )
        )
    return lines


def markdown_table(scores: Sequence[Score]) -> str:
    """The main results as Markdown, with a row for each trial."""

    def mean(trial: Trial, sampler: str, draws: Draws, field: str, digits: int = 2) -> str:
        chosen = [s for s in scores if (s.trial, s.sampler, s.draws) == (trial.name, sampler, draws)]
        estimate = mean_interval(getattr(s, field) for s in chosen).estimate
        return "–" if np.isnan(estimate) else f"{estimate:.{digits}f}"

    names = ("predictor, paper", "here", "combined, paper", "here", "causal: Pearson", "total variation", "valid mass")
    lines = []
    for trial in TRIALS:
        cells = [
            f"{trial.paper_predictor:.2f}",
            mean(trial, PREDICTOR, "many", "union"),
            f"{trial.paper_combined:.2f}",
            mean(trial, COMBINED, "many", "union"),
            mean(trial, CAUSAL, "exact", "full", 4),
            mean(trial, CAUSAL, "exact", "variation", 4),
            mean(trial, CAUSAL, "exact", "valid", 4),
        ]
        lines.append([f"{trial.name} (d = {trial.options.d}, c = {trial.options.c})", *cells])
    return Table(["trial", *names], lines).markdown()


@dataclass(frozen=True)
class VariantLine:
    """One variant: correlation and total variation in each trial, by the trial's name."""

    name: str
    union: dict[str, Cell]
    variation: dict[str, Cell]


def variant_table(scores: Sequence[Score]) -> list[VariantLine]:
    """The rows of the table of variants."""
    trials = list(dict.fromkeys(score.trial for score in scores))

    def cells(name: str, field: str) -> dict[str, Cell]:
        chosen = [score for score in scores if score.sampler == name]
        return {trial: cell(getattr(s, field) for s in chosen if s.trial == trial) for trial in trials}

    names = dict.fromkeys(score.sampler for score in scores)
    return [VariantLine(name, cells(name, "union"), cells(name, "variation")) for name in names]


def paper_parameters(d: int) -> tuple[int, int]:
    """Weights of predictor and conditioner by the paper's counts: 2d + 1 hidden nodes, 2d^2 + 1 without the pruned weights.

    Predictor: d (2d + 1) + (2d + 1) d weights, and biases. Conditioner: 2d nodes in each of d groups, each with weights from d
    inputs and d - 1 other outputs, a bias and one weight to its output, and the biases of the outputs.
    """
    predictor = d * (2 * d + 1) + (2 * d + 1) * d + (2 * d + 1) + d
    conditioner = 2 * d * d * (d + d - 1 + 1 + 1) + d
    return predictor, conditioner


def statements(scores: Sequence[Score]) -> list[Statement]:
    """The conclusions of section 3.4 that can be checked with the given trials."""
    present = {score.trial for score in scores}
    found = [_better_than_alone(scores)]
    if {"1a", "1b"} <= present:
        found.append(_milder_without_correlation(scores))
    if {"2b", "3"} <= present:
        found.append(_falls(scores, ("2b", "3"), "Performance deteriorates with the number of dimensions"))
    if {"2a", "2b", "2c"} <= present:
        found.append(_falls(scores, ("2a", "2b", "2c"), "Sparser data is easier to model"))
    return [*found, *_zeros_and_ones(scores)]


def _values(scores: Sequence[Score], trial: str, sampler: str, read: Callable[[Score], float]) -> np.ndarray:
    """One value per seed, from the scores with many samples."""
    chosen = [s for s in scores if (s.trial, s.sampler, s.draws) == (trial, sampler, "many")]
    return np.array([read(s) for s in sorted(chosen, key=lambda s: s.seed)], dtype=np.float64)


def _union(score: Score) -> float:
    return score.union


def _gain(scores: Sequence[Score], trial: str) -> np.ndarray:
    gain: np.ndarray = _values(scores, trial, COMBINED, _union) - _values(scores, trial, PREDICTOR, _union)
    return gain


def _better_than_alone(scores: Sequence[Score]) -> Statement:
    gains = {trial.name: _gain(scores, trial.name) for trial in TRIALS if any(s.trial == trial.name for s in scores)}
    cells = {name: mean_interval(gain) for name, gain in gains.items()}
    text = "; ".join(f"{name} {_signed(c)}" for name, c in cells.items())
    return Statement(
        "The combined sampler is always superior to the predictor alone",
        f"gain in correlation: {text}",
        _all([_above_zero(c) for c in cells.values()]),
    )


def _milder_without_correlation(scores: Sequence[Score]) -> Statement:
    low, high = _gain(scores, "1a"), _gain(scores, "1b")
    text = f"gain {_signed(mean_interval(low))} in 1a (uncorrelated), {_signed(mean_interval(high))} in 1b (correlated)"
    return Statement("Without correlation between variables the difference is milder", text, _greater(high, low))


def _falls(scores: Sequence[Score], trials: tuple[str, ...], text: str) -> Statement:
    values = [_values(scores, trial, COMBINED, _union) for trial in trials]
    wrong = [mean_interval(_values(scores, trial, COMBINED, lambda s: s.variation)).estimate for trial in trials]
    pairs = ", ".join(
        f"{trial}: correlation {mean_interval(v).estimate:.3f}, total variation {tv:.3f}"
        for trial, v, tv in zip(trials, values, wrong, strict=True)
    )
    return Statement(text, pairs, _all([_greater(first, second) for first, second in itertools.pairwise(values)]))


def _zeros_and_ones(scores: Sequence[Score]) -> list[Statement]:
    early = f"{COMBINED}, {FEW_ITERATIONS} iterations"
    chosen = {
        name: [s for s in scores if (s.sampler, s.draws) == (sampler, "many")]
        for name, sampler in (("early", early), ("late", COMBINED))
    }
    zero, one = (mean_interval(getattr(s, field) for s in chosen["late"]) for field in ("at_zero", "at_one"))
    one_early = mean_interval(s.at_one for s in chosen["early"]).estimate
    mass = {name: np.array([1.0 - s.valid for s in group]) for name, group in chosen.items()}
    means = {name: mean_interval(values).estimate for name, values in mass.items()}
    below_one = _above_zero(mean_interval(1.0 - s.at_one for s in chosen["late"]))
    return [
        Statement(
            "Transitions with observed probability zero are overestimated, those with probability one underestimated",
            f"mean estimate {zero.estimate:.5f} over all outcomes never observed (d up to 8), {one.estimate:.3f} where only "
            "one was ever observed",
            _all([_above_zero(zero), below_one]),
        ),
        Statement(
            "More training pushes the estimates closer to the frequencies",
            f"mass on outcomes never observed: {means['early']:.3f} after {FEW_ITERATIONS} iterations, {means['late']:.3f} at "
            f"the end; estimate where only one was observed: {one_early:.3f}, then {one.estimate:.3f}",
            _greater(mass["early"], mass["late"]),
        ),
    ]


def _signed(interval: Interval) -> str:
    ends = "" if np.isnan(interval.low) else f" [{interval.low:+.3f}, {interval.high:+.3f}]"
    return f"{interval.estimate:+.3f}{ends}"


def _above_zero(interval: Interval) -> bool | None:
    """Whether a mean is above zero; None if its interval leaves it open."""
    if interval.high <= 0.0:
        return False
    return True if interval.low > 0.0 else None


def _greater(first: np.ndarray, second: np.ndarray) -> bool | None:
    """Whether one mean is above another, by Welch's test at 5%; None if the test leaves it open."""
    first, second = (values[~np.isnan(values)] for values in (first, second))
    if min(len(first), len(second)) < 2 or np.ptp(first) + np.ptp(second) == 0.0:
        return None
    if stats.ttest_ind(first, second, equal_var=False).pvalue >= 0.05:
        return None
    return bool(first.mean() > second.mean())


def _all(held: Sequence[bool | None]) -> bool | None:
    """Whether all hold; None if none fails and some are open."""
    if any(one is False for one in held):
        return False
    return None if None in held else True
