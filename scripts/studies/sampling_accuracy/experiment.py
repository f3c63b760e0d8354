"""The plan of the measurements: every sampler in every trial, single changes, and growing numbers of variables."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import torch

from harness import Result, check_known
from studies.sampling_accuracy import samplers as s
from studies.sampling_accuracy.data import DataOptions, generate
from studies.sampling_accuracy.scores import FEW_DRAWS, Bench, timed
from studies.sampling_accuracy.trials import SCALING, TRIALS, Trial, find_trial
from studies.sampling_accuracy.variants import VARIANTS, fit_masked

FIRST_SCORED_SEED = 1000
"""First scored seed; settings were chosen on smaller seeds."""

FEW_ITERATIONS = 25
"""A tenth of the iterations, to test the paper's remark on more training."""

SLOW_SEEDS = 5
"""Number of data sets per trial for the Boltzmann machine, a baseline that takes longer than all other samplers together."""

MOST_DRAWS = 1_000_000

Part = Literal["samplers", "variants", "scaling"]
"""Every sampler in every trial; variants of the combined sampler, with one change each; growing numbers of variables."""

TABLES: dict[Part, str] = {"samplers": "results", "variants": "variants", "scaling": "scaling"}
"""Names of the tables of the parts."""

VARIED = {"2a": 5, "2c": 5, "3": 1}
"""Trials for the variants, with the number of data sets: those in which the paper reports better results than its networks
reach here."""


@dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    Attributes:
        trials: names of the trials.
        seeds: data sets for each trial; None for the trial's own number.
        first_seed: number of the first data set.
        n_draws: samples per input where many are drawn.
        fit: options for fitting the paper's networks.
        relates, shuffle, multiplier: see DataOptions.
        parts: see Part.

    Raises:
        ValueError: a setting is out of range.
    """

    trials: tuple[str, ...] = tuple(trial.name for trial in TRIALS)
    seeds: int | None = None
    first_seed: int = FIRST_SCORED_SEED
    n_draws: int = 1000
    fit: s.FitOptions = field(default_factory=s.FitOptions)
    relates: Literal["previous", "input"] = "previous"
    shuffle: Literal["output", "input"] = "output"
    multiplier: float = 1.0
    parts: tuple[Part, ...] = ("samplers",)

    def __post_init__(self) -> None:
        """Checks the ranges."""
        check_known("trial", self.trials, [trial.name for trial in TRIALS])
        if self.seeds is not None and self.seeds < 1:
            raise ValueError(f"seeds must be at least 1 data set, got {self.seeds}.")
        if self.first_seed < 0:
            raise ValueError(f"first_seed must be 0 or more, got {self.first_seed}.")
        if not 1 <= self.n_draws <= MOST_DRAWS:
            raise ValueError(f"n_draws must lie between 1 and {MOST_DRAWS:,}, got {self.n_draws:,}.")
        if not cells(self):
            raise ValueError(
                "There is nothing to measure: name at least one trial and one part "
                f"(variants are measured in {', '.join(VARIED)})."
            )

    def measured(self) -> dict[str, Any]:
        """All settings that affect results, as plain values: runs with equal ones may be combined."""
        kept = asdict(self)
        return {name: kept[name] for name in ("n_draws", "relates", "shuffle", "multiplier", "fit")}


@dataclass(frozen=True)
class Cell:
    """One part of one trial with one seed."""

    trial: str
    seed: int
    settings: Settings
    part: Part = "samplers"

    @property
    def options(self) -> DataOptions:
        """The data's parameters."""
        given, options = self.settings, find_trial(self.trial).options
        # Growing numbers of variables use their own multiplier, without which the largest could not be fitted.
        b = options.multiplier if self.part == "scaling" else given.multiplier
        return replace(options, relates=given.relates, shuffle=given.shuffle, multiplier=b)

    @property
    def place(self) -> tuple[int, int]:
        """Sort key of the rows of a table: trial and seed."""
        return [trial.name for trial in (*TRIALS, *SCALING)].index(self.trial), self.seed


def cells(settings: Settings) -> list[Cell]:
    """All cells, longest first."""
    found: list[Cell] = []
    chosen = [find_trial(name) for name in dict.fromkeys(settings.trials)]
    for part in dict.fromkeys(settings.parts):
        for trial in SCALING if part == "scaling" else chosen:
            n = min(_seeds(part, trial), settings.seeds or 10**9)
            found += [Cell(trial.name, settings.first_seed + i, settings, part) for i in range(n)]
    return sorted(found, key=lambda cell: (-cell.options.d, -cell.options.n_inputs))


def _seeds(part: Part, trial: Trial) -> int:
    return VARIED.get(trial.name, 0) if part == "variants" else trial.seeds


def run_cell(cell: Cell) -> Result[Cell]:
    """Fits and measures samplers on one data set.

    The rows are those of ``Score``; ``arrays`` holds pairs (observed, inferred) [M, 2] for the scatter plots, by sampler.
    """
    torch.set_num_threads(1)
    n_draws = cell.settings.n_draws
    if cell.part != "samplers" and cell.options.d > s.EXHAUSTIVE:
        n_draws = min(n_draws, FEW_DRAWS)
    bench = Bench(cell.trial, cell.seed, generate(cell.options, cell.seed), n_draws)
    if cell.part == "samplers":
        _samplers(bench, cell.settings.fit, slow_ones=cell.seed < cell.settings.first_seed + SLOW_SEEDS)
    else:
        {"variants": _variants, "scaling": _scaling}[cell.part](bench, cell.settings.fit)
    rows = [asdict(score) for score in bench.scores]
    return Result(cell, {TABLES[cell.part]: rows}, f"{cell.part}, {cell.trial}, data set {cell.seed}", bench.points)


def _samplers(bench: Bench, fit: s.FitOptions, slow_ones: bool) -> None:
    data, seed = bench.data, bench.seed
    (alone, combined), seconds = timed(lambda: s.fit_paper(data, fit, seed))
    bench.many(s.PREDICTOR, alone, seconds, keep=True)
    bench.many(s.COMBINED, combined, seconds, keep=True)
    few = replace(fit, iterations=FEW_ITERATIONS)
    (_, early), seconds = timed(lambda: s.fit_paper(data, few, seed))
    bench.many(f"{s.COMBINED}, {FEW_ITERATIONS} iterations", early, seconds, slow=True)
    causal, seconds = timed(lambda: s.fit_causal(data, seed))
    bench.every_way(s.CAUSAL, causal, seconds)
    if slow_ones:
        machine, seconds = timed(lambda: s.fit_boltzmann(data, seed))
        bench.many(s.BOLTZMANN, machine, seconds, slow=True)
        if machine.n_outcomes <= 2 ** (s.EXHAUSTIVE + 1):
            bench.exact(s.BOLTZMANN, machine, seconds)
    table, seconds = timed(lambda: s.fit_table(data, prior=1.0))
    bench.exact(s.TABLE, table, seconds)
    perfect, seconds = timed(lambda: s.fit_table(data, prior=0.0))
    bench.every_way(s.PERFECT, perfect, seconds)


def _variants(bench: Bench, fit: s.FitOptions) -> None:
    for variant in VARIANTS:
        found, seconds = timed(lambda variant=variant: variant.sample(bench.data, fit, bench.n_draws, bench.seed))  # type: ignore[misc]
        bench.add(variant.name, "many", found, seconds=seconds)


def _scaling(bench: Bench, fit: s.FitOptions) -> None:
    (alone, combined), seconds = timed(lambda: s.fit_paper(bench.data, fit, bench.seed))
    bench.many(s.PREDICTOR, alone, seconds)
    bench.many(s.COMBINED, combined, seconds)
    masked, seconds = timed(lambda: fit_masked(bench.data, fit, bench.seed))
    bench.exact(s.CAUSAL, masked, seconds)
    bench.many(s.CAUSAL, masked, seconds)
