"""Cost of one sampled next state: the naive procedure in torch, the compiled samplers, and their short cut."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy import stats

from mbagent.models.neural.model import NeuralTransitionModel, PrunedAs
from mbagent.types import Floats, Ints
from mbagent_envs.random_keys import derive
from worlds.synthetic_dbn import random_inputs

TRUSTED = 0.98
"""With the short cut, variables whose most likely value has at least this probability are sampled from the predictor."""

EVERYTHING = 1.1
"""No variable is sampled from the predictor only."""

BARS_NAIVE = {1: 100.0, 64: 25.0, 4096: 25.0}
"""Required speed relative to the naive procedure at each batch size, for d = 32."""

BARS_SHORT_CUT = {32: 8.0, 128: 40.0}
"""Required speed of the short cut relative to the full sweep for each d."""

BAR_VARIATION = 0.01
"""Largest allowed total variation between the two."""


@dataclass(frozen=True)
class SpeedUp:
    """A compiled sampler compared with the naive procedure.

    Attributes:
        sampler: see ``build_sampler``.
        d: number of bits.
        batch: batch size.
        naive: microseconds of processor time per sampled state.
        compiled: the same for the compiled sampler.
        ratio: ratio of the two.
        bar: required ratio; nan if there is none.
    """

    sampler: str
    d: int
    batch: int
    naive: float
    compiled: float
    ratio: float
    bar: float


@dataclass(frozen=True)
class ShortCut:
    """Resampling of the uncertain variables only, compared with the full sweep.

    Attributes:
        d: number of bits.
        sweeps: passes over the variables.
        uncertain: variables that are uncertain by the predictor, mean over inputs. If everything else cost nothing, the short
            cut would be variables / uncertain times as fast.
        full: microseconds of processor time per state sampled by the full sweep.
        short: the same for the short cut.
        begun: the same for the initial work of both: predictor, first guess, and the first sums of the uncertain variables.
        ratio: ratio of full and short.
        bar: required ratio.
        same_luck: share of samples that differ with the same random numbers. In any coupling, two random variables differ with
            at least the probability given by the total variation of their distributions; so this is an upper bound of the
            total variation of the whole next state, without additional sampling noise.
        bound: 95% confidence limit of ``same_luck`` for the finite number of samples.
        joint: total variation between the short cut and the full sweep, estimated from frequencies with other random numbers.
        floor: the same estimate for two runs of the full sweep, whose total variation is 0: the effect of sampling noise.
        pairs: as ``joint``, for pairs of variables, mean over all pairs.
        pairs_floor: as ``floor``, for pairs.
    """

    d: int
    sweeps: int
    uncertain: float
    full: float
    short: float
    begun: float
    ratio: float
    bar: float
    same_luck: float
    bound: float
    joint: float
    floor: float
    pairs: float
    pairs_floor: float


@torch.inference_mode()
def naive_sample(model: NeuralTransitionModel, states: Ints, actions: Ints, seed: int) -> Ints:
    """The straightforward procedure: a full forward pass of both networks for each sampled variable.

    Args:
        model: model of bits with a conditioner; one pass over the variables, in order.
        states: states int64 [B, F].
        actions: actions int64 [B].
        seed: seed of the samples.

    Returns:
        Samples int64 [B, F + 1], ``terminated`` last.
    """
    assert model.conditioner is not None
    generator = torch.Generator().manual_seed(seed)
    s, a = torch.from_numpy(states), torch.from_numpy(actions)
    guess = torch.softmax(model.predictor(s, a), dim=2)[:, :, 1]
    outcome = (torch.rand(guess.shape, generator=generator) < guess).long()
    for i in range(outcome.shape[1]):
        logits = model.predictor(s, a) + model.conditioner(s, a, outcome)
        p = torch.softmax(logits[:, i], dim=1)[:, 1]
        outcome[:, i] = (torch.rand(p.shape, generator=generator) < p).long()
    drawn: Ints = outcome.numpy()
    return drawn


@contextmanager
def using(model: NeuralTransitionModel, certain: float, sweeps: int, pruned_as: PrunedAs = "matrices") -> Iterator[None]:
    """Uses other settings of the model's sampler; ``pruned_as`` selects how a pruned model is sampled."""
    before = model.config, model.pruned_as
    model.config, model.pruned_as = replace(model.config, certain=certain, sweeps=sweeps), pruned_as
    try:
        yield
    finally:
        model.config, model.pruned_as = before


def microseconds(call: Callable[[], object], rows: int, at_least: float = 0.3, repetitions: int = 5) -> float:
    """Processor time per row, as median over repetitions that last ``at_least`` seconds in all; the first call is not timed."""
    call()
    began = time.process_time()
    call()
    once = max(time.process_time() - began, 1e-6)
    calls = max(1, int(at_least / repetitions / once))
    found = []
    for _ in range(repetitions):
        began = time.process_time()
        for _ in range(calls):
            call()
        found.append((time.process_time() - began) / calls)
    return float(np.median(found)) / rows * 1e6


def compare_with_naive(model: NeuralTransitionModel, sampler: str, batches: Sequence[int], seed: int) -> list[SpeedUp]:
    """The model's own ``sample``, with its overhead, compared with the naive procedure."""
    d, rng, rows = len(model.cardinalities), np.random.default_rng(seed), []
    for batch in batches:
        states, actions = random_inputs(d, batch, rng)
        keys = derive(seed, np.arange(batch))
        naive = microseconds(partial(naive_sample, model, states, actions, seed), batch)
        fast = microseconds(partial(model.sample, states, actions, keys), batch)
        bar = BARS_NAIVE.get(batch, np.nan) if d == 32 else np.nan
        rows.append(SpeedUp(sampler, d, batch, naive, fast, naive / fast, bar))
    return rows


def total_variation(first: Ints, second: Ints) -> float:
    """Total variation between two samples of outcomes, int64 [N, V] each, from their frequencies."""
    both = np.ascontiguousarray(np.concatenate([first, second]).astype(np.int8))
    _, number = np.unique(both.view(np.dtype((np.void, both.shape[1]))).ravel(), return_inverse=True)
    counts = [np.bincount(part, minlength=number.max() + 1) / len(part) for part in np.split(number, [len(first)])]
    return float(0.5 * np.abs(counts[0] - counts[1]).sum())


def pair_variations(first: Ints, second: Ints) -> Floats:
    """Total variation of the joint distribution of bits i and j between two samples [N, V], for all i < j."""
    on = [sample.astype(np.float32) for sample in (first, second)]
    both = on[0].T @ on[0] / len(first) - on[1].T @ on[1] / len(second)  # differences of P(1, 1)
    one = on[0].mean(axis=0) - on[1].mean(axis=0)
    parts = (both, one[:, None] - both, one[None, :] - both, both - one[:, None] - one[None, :])
    found: Floats = 0.5 * np.abs(np.stack(parts)).sum(axis=0)[np.triu_indices(first.shape[1], 1)].astype(np.float64)
    return found


def compare_short_cut(model: NeuralTransitionModel, sweeps: int, seed: int, n_inputs: int, n_draws: int) -> ShortCut:
    """Full sweeps compared with sweeps over uncertain variables only: cost, and distance of their distributions.

    Args:
        model: model with a conditioner masked "others".
        sweeps: number of passes.
        seed: seed of inputs and samples.
        n_inputs: number of states and actions for which distributions are compared; results are means over them.
        n_draws: samples for each input.
    """
    d, rng = len(model.cardinalities), np.random.default_rng(seed)
    states, actions = random_inputs(d, 1024, rng)
    keys = derive(seed, np.arange(len(states)))
    times = []
    for certain, passes in ((EVERYTHING, sweeps), (TRUSTED, sweeps), (TRUSTED, 0)):
        with using(model, certain, passes):
            times.append(microseconds(lambda: model.sample(states, actions, keys), len(states)))
    uncertain = (model.probabilities(states, actions).max(axis=2) < TRUSTED).sum(axis=1).mean()
    apart = np.array([_apart(model, sweeps, states[i], actions[i], seed + i, n_draws) for i in range(n_inputs)]).mean(axis=0)
    same_luck, joint, floor, pairs, pairs_floor = (float(x) for x in apart)
    ratio, bar = times[0] / times[1], BARS_SHORT_CUT.get(d, np.nan)
    bound = upper_limit(same_luck, n_inputs * n_draws)
    full, short, begun = times
    return ShortCut(
        d, sweeps, float(uncertain), full, short, begun, ratio, bar, same_luck, bound, joint, floor, pairs, pairs_floor
    )


def upper_limit(share: float, n: int) -> float:
    """Upper 95% confidence limit of the probability of an event with this share in n trials (Clopper and Pearson 1934)."""
    hits = round(share * n)
    return 1.0 if hits >= n else float(stats.beta.ppf(0.95, hits + 1, n - hits))


def _apart(model: NeuralTransitionModel, sweeps: int, state: Ints, action: np.int64, seed: int, n: int) -> tuple[float, ...]:
    """For one input: share of samples that differ, joint total variation and its floor, and these two for the mean pair."""
    given = np.tile(state, (n, 1)), np.full(n, action)
    draws = []
    for certain, run in ((EVERYTHING, 0), (TRUSTED, 0), (EVERYTHING, 1)):
        with using(model, certain, sweeps):
            draws.append(np.column_stack(model.sample(*given, derive(seed, np.arange(n), run))).astype(np.int64))
    full, short, again = draws
    return (
        float((full != short).any(axis=1).mean()),
        total_variation(again, short),
        total_variation(again, full),
        float(pair_variations(again, short).mean()),
        float(pair_variations(again, full).mean()),
    )
