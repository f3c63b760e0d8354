"""Fits every sampler to every trial's data and measures it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch

from mbagent.analysis.accuracy import samplers as s
from mbagent.analysis.accuracy.data import Observations, generate
from mbagent.analysis.accuracy.measures import (
    Distribution,
    align,
    full_correlation,
    observed_correlation,
    total_variation,
    union_correlation,
    valid_mass,
)
from mbagent.analysis.accuracy.trials import TRIALS, find_trial
from mbagent.models.base import TransitionModel

Draws = Literal["exact", "many", "c", "c systematic"]
"""How a distribution was found: exact probabilities, many independent draws, c independent or c systematic ones."""

FIRST_SCORED_SEED = 1000
"""Seeds from here on are scored; settings were chosen on those below."""

FEW_ITERATIONS = 25
"""For the paper's remark on more training: the same networks after a tenth of the iterations."""

NAN = float("nan")


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        trials: names.
        seeds: data sets for each trial; None for the trial's own number.
        first_seed: number of the first of them.
        n_draws: draws for each input where they are many.
        fit: how the paper's networks are fitted.
        relates, shuffle, multiplier: see DataOptions.
    """

    trials: tuple[str, ...] = tuple(trial.name for trial in TRIALS)
    seeds: int | None = None
    first_seed: int = FIRST_SCORED_SEED
    n_draws: int = 1000
    fit: s.FitOptions = field(default_factory=s.FitOptions)
    relates: Literal["previous", "input"] = "previous"
    shuffle: Literal["output", "input"] = "output"
    multiplier: float = 1.0


@dataclass(frozen=True)
class Score:
    """One sampler on one data set.

    Attributes:
        trial, seed: which data.
        sampler: its name.
        draws: how its distribution was found.
        union: Pearson over the outcomes observed or generated, the paper's; NaN where undefined.
        seen: Pearson over the outcomes observed.
        full: Pearson over all outcomes; NaN where they are too many to list.
        variation: total variation, mean over inputs.
        valid: generated mass on observed outcomes, mean over inputs.
        log_likelihood: nats an observation, from exact probabilities; else NaN.
        at_zero: mean probability given to the generated outcomes that were never observed.
        at_one: mean probability given to outcomes that were always observed; NaN if there are none.
        parameters: number of weights.
        fit_seconds, sample_microseconds: processor time of the fit, and of one draw.
    """

    trial: str
    seed: int
    sampler: str
    draws: Draws
    union: float
    seen: float
    full: float
    variation: float
    valid: float
    log_likelihood: float = NAN
    at_zero: float = NAN
    at_one: float = NAN
    parameters: int = 0
    fit_seconds: float = NAN
    sample_microseconds: float = NAN


@dataclass(frozen=True)
class Task:
    """One trial with one seed."""

    trial: str
    seed: int
    settings: Settings


@dataclass(frozen=True)
class Outcome:
    """What a task found; ``points`` holds pairs (observed, inferred) [M, 2] for the scatter plots, by sampler."""

    task: Task
    scores: list[Score]
    points: dict[str, np.ndarray]


def plan(settings: Settings) -> list[Task]:
    """All tasks, the longest first."""
    tasks = []
    for trial in sorted(map(find_trial, settings.trials), key=lambda trial: -trial.options.d):
        n = trial.seeds if settings.seeds is None else settings.seeds
        tasks += [Task(trial.name, settings.first_seed + i, settings) for i in range(n)]
    return tasks


def run_task(task: Task) -> Outcome:
    """Fits and measures every sampler on one data set."""
    torch.set_num_threads(1)
    settings = task.settings
    more = {"relates": settings.relates, "shuffle": settings.shuffle, "multiplier": settings.multiplier}
    options = replace(find_trial(task.trial).options, **more)  # type: ignore[arg-type]  # checked at run time
    bench = _Bench(task, generate(options, task.seed))
    fit, seed = settings.fit, task.seed
    (alone, combined), seconds = _timed(lambda: s.fit_paper(bench.data, fit, seed))
    bench.many(s.PREDICTOR, alone, seconds, keep=True)
    bench.many(s.COMBINED, combined, seconds, keep=True)
    few = replace(fit, iterations=FEW_ITERATIONS)
    (_, early), seconds = _timed(lambda: s.fit_paper(bench.data, few, seed))
    bench.many(f"{s.COMBINED}, {FEW_ITERATIONS} iterations", early, seconds)
    causal, seconds = _timed(lambda: s.fit_causal(bench.data, seed))
    bench.every_way(s.CAUSAL, causal, seconds)
    machine, seconds = _timed(lambda: s.fit_boltzmann(bench.data, seed))
    bench.many(s.BOLTZMANN, machine, seconds)
    if machine.n_outcomes <= 2 ** (s.EXHAUSTIVE + 1):
        bench.exact(s.BOLTZMANN, machine, seconds)
    table, seconds = _timed(lambda: s.fit_table(bench.data, prior=1.0))
    bench.exact(s.TABLE, table, seconds)
    perfect, seconds = _timed(lambda: s.fit_table(bench.data, prior=0.0))
    bench.every_way(s.PERFECT, perfect, seconds)
    return Outcome(task, bench.scores, bench.points)


class _Bench:
    """Collects the scores of one task."""

    def __init__(self, task: Task, data: Observations) -> None:
        self.task, self.data = task, data
        self.truth = s.observed(data)
        self.scores: list[Score] = []
        self.points: dict[str, np.ndarray] = {}

    def exact(self, sampler: str, model: TransitionModel, seconds: float) -> None:
        found = s.exact(model, self.data)
        self._add(sampler, "exact", found, model, seconds, log_likelihood=s.log_likelihood(self.truth, found))

    def many(self, sampler: str, model: TransitionModel, seconds: float, keep: bool = False) -> None:
        self._drawn(sampler, "many", model, seconds, self.task.settings.n_draws)
        if keep:
            found = s.draw(model, self.data, self.task.settings.n_draws, self.task.seed)
            self.points[sampler] = np.stack(align(self.truth, found), axis=1)

    def every_way(self, sampler: str, model: TransitionModel, seconds: float) -> None:
        """By exact probabilities, many draws, c draws and c systematic draws."""
        c = self.data.outputs.shape[1]
        self.exact(sampler, model, seconds)
        self.many(sampler, model, seconds)
        self._drawn(sampler, "c", model, seconds, c)
        self._add(sampler, "c systematic", s.draw_systematically(model, self.data, c, self.task.seed), model, seconds)

    def _drawn(self, sampler: str, draws: Draws, model: TransitionModel, seconds: float, n: int) -> None:
        found, took = _timed(lambda: s.draw(model, self.data, n, self.task.seed))
        each = took * 1e6 / (n * len(self.data.inputs))
        self._add(sampler, draws, found, model, seconds, sample_microseconds=each)

    def _add(
        self, sampler: str, draws: Draws, found: Distribution, model: TransitionModel, seconds: float, **more: float
    ) -> None:
        truth, d = self.truth, self.data.d
        p, q = align(truth, found)
        listed = found.complete
        self.scores.append(
            Score(
                trial=self.task.trial,
                seed=self.task.seed,
                sampler=sampler,
                draws=draws,
                union=union_correlation(truth, found) if draws != "exact" else NAN,
                seen=observed_correlation(truth, found),
                full=full_correlation(truth, found, d) if listed and d <= s.EXHAUSTIVE else NAN,
                variation=total_variation(truth, found),
                valid=valid_mass(truth, found),
                at_zero=_mean(q[p == 0.0]) if listed else NAN,
                at_one=_mean(q[p > 1.0 - 1e-9]),
                parameters=sum(int(np.size(array)) for array in model.state_dict().values()),
                fit_seconds=seconds,
                **more,
            )
        )


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else NAN


def _timed(work: Callable[[], s.T]) -> tuple[s.T, float]:
    """What the work returns, and the processor seconds it took."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def collect(outcomes: Sequence[Outcome]) -> list[Score]:
    """All scores, in the order of trials and seeds."""
    order = {trial.name: i for i, trial in enumerate(TRIALS)}
    found = sorted(outcomes, key=lambda o: (order[o.task.trial], o.task.seed))
    return [score for outcome in found for score in outcome.scores]
