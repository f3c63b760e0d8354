"""Model error: calibrated probability that a model's most likely prediction is wrong (the paper's section 6).

A model estimates how random the environment is, but not its own error. Models fitted with a different part of the episodes left
out each time (the jackknife) disagree where data are scarce. Isotonic regression (Zadrozny and Elkan 2002) maps the error that
these models predict on average to the frequency of wrong predictions on held-out parts, which is the calibrated probability.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.protocol import TransitionModel
from mbagent.types import Actions, Bools, Floats, Ints, States

BELIEVED = 20.0
"""Weight of the uncalibrated doubts in the calibration, in held-out transitions."""


_IDENTITY = np.array([0.0, 1.0]), np.array([0.0, 1.0])


@dataclass(frozen=True)
class ModelError:
    """The estimated error of a model.

    Attributes:
        model: the model.
        members: models fitted to the same data, each with a different part left out.
        doubts: values of ``doubt`` at the points of the calibration curve, ascending, [K].
        rates: frequency of wrong predictions at these doubts, [K].
    """

    model: TransitionModel
    members: tuple[TransitionModel, ...]
    doubts: Floats
    rates: Floats

    def __call__(self, states: States, actions: Actions) -> Floats:
        """Probability that the outcome is not the model's most likely one, by chance or because of model error, [B]."""
        return np.interp(self.doubt(states, actions), self.doubts, self.rates)

    def doubt(self, states: States, actions: Actions) -> Floats:
        """Probability of outcomes other than the model's most likely one, averaged over the model and all members, [B]."""
        following, ends = likeliest(self.model, states, actions)
        logs = [model.log_prob(states, actions, following, ends) for model in (self.model, *self.members)]
        result: Floats = 1.0 - np.exp(logs).mean(axis=0)
        return result.clip(0.0, 1.0)

    def disagreement(self, states: States, actions: Actions) -> Floats:
        """Standard deviation of P(model's most likely outcome) over model and members, [B]; more data would reduce it."""
        following, ends = likeliest(self.model, states, actions)
        logs = [model.log_prob(states, actions, following, ends) for model in (self.model, *self.members)]
        result: Floats = np.exp(logs).std(axis=0)
        return result


def estimate_error(
    build: Callable[[], TransitionModel],
    model: TransitionModel,
    data: TransitionDataset,
    *,
    n_members: int = 5,
    seed: int = 0,
) -> ModelError:
    """Estimates the error of a model.

    Args:
        build: creates an unfitted model of the same kind.
        model: the model, fitted to ``data``; it needs exact probabilities.
        data: the transitions that ``model`` was fitted to.
        n_members: number of members, the models that are compared with ``model``. The episodes are divided into ``n_members``
            parts, and each member is fitted without one of the parts. For the calibration, a further model is fitted without
            each pair of parts, so 5 members need 15 fits in all.
        seed: seed of the fits and parts.

    Raises:
        ValueError: there are fewer than 50 transitions, or fewer than 3 members.
        NotImplementedError: the model has no exact probabilities.
    """
    if len(data) < 50 or n_members < 3:
        raise ValueError(
            f"An error estimate needs at least 50 transitions and 3 members, got {len(data)} and {n_members}; explore first."
        )
    rows = data.rows()
    _check_probabilities(model, rows.select(np.arange(1)))

    def fitted(kept: Bools) -> TransitionModel:
        sample = TransitionDataset(data.cardinalities, data.n_actions)
        sample.append(rows.select(kept))
        member = build()
        member.fit(sample, seed=seed)
        return member

    part = parts_of(rows, n_members, seed)
    members = tuple(fitted(part != number) for number in range(n_members))
    without = {pair: fitted(~np.isin(part, pair)) for pair in itertools.combinations(range(n_members), 2)}
    doubts, wrong = [], []
    for number, member in enumerate(members):
        others = tuple(other for pair, other in without.items() if number in pair)
        held_out = rows.select(part == number)
        doubts.append(ModelError(member, others, *_IDENTITY).doubt(held_out.states, held_out.actions))
        wrong.append(missed(member, held_out))
    return ModelError(model, members, *_calibrated(np.concatenate(doubts), np.concatenate(wrong)))


def _check_probabilities(model: TransitionModel, row: TransitionBatch) -> None:
    """Checks that a model has exact probabilities, before any fit.

    Raises:
        NotImplementedError: it has none.
    """
    try:
        model.log_prob(row.states, row.actions, row.next_states, row.terminated)
    except NotImplementedError as error:
        raise NotImplementedError(
            f"An error estimate needs exact probabilities, which {type(model).__name__} does not have; use one that has "
            'log_prob, such as model="graphs".'
        ) from error


def parts_of(rows: TransitionBatch, n_parts: int, seed: int) -> Ints:
    """Part of each row, 0 ... n_parts - 1, int64 [N]: sets of whole episodes or, if there are few, of runs of rows."""
    groups = np.unique(rows.episodes, return_inverse=True)[1]
    if groups.max() + 1 < 2 * n_parts:
        groups = np.arange(len(rows)) * 2 * n_parts // len(rows)
    part = np.random.default_rng(seed).permutation(groups.max() + 1) % n_parts
    result: Ints = part[groups]
    return result


def likeliest(model: TransitionModel, states: States, actions: Actions) -> tuple[States, Bools]:
    """Most likely next states, int64 [B, F], and ``terminated``, bool [B]: by ``model.likeliest``, else by factor."""
    method = getattr(model, "likeliest", None)
    if method is not None:
        found: tuple[States, Bools] = method(states, actions)
        return found
    probs, start = model.marginals(states, actions), np.concatenate([[0], np.cumsum(model.cardinalities)])
    columns = [probs[:, begin:end].argmax(axis=1) for begin, end in itertools.pairwise(start)]
    following = np.stack(columns, axis=1).astype(np.int64)
    logs = [model.log_prob(states, actions, following, np.full(len(states), end)) for end in (False, True)]
    return following, logs[1] > logs[0]


def missed(model: TransitionModel, rows: TransitionBatch) -> Bools:
    """Whether each row's outcome is not the model's most likely one, bool [N]."""
    following, ends = likeliest(model, rows.states, rows.actions)
    result: Bools = (following != rows.next_states).any(axis=1) | (ends != rows.terminated)
    return result


def _calibrated(doubts: Floats, wrong: Bools) -> tuple[Floats, Floats]:
    """Calibration curve: doubts and error rates, both ascending; close to the identity if there are few held-out transitions.

    Doubts with the same rate are replaced by their mean, so that the curve strictly increases (Oron and Flournoy 2017).
    """
    own = np.quantile(doubts, np.linspace(0.0, 1.0, 11)) if len(doubts) else np.zeros(0)
    x = np.concatenate([doubts, own, [0.0, 1.0]])
    y = np.concatenate([wrong.astype(np.float64), own, [0.0, 1.0]])
    weights = np.concatenate([np.ones(len(doubts)), np.full(len(own), BELIEVED / 13.0), np.full(2, BELIEVED / 13.0)])
    order = np.argsort(x, kind="stable")
    levels, place = np.unique(x[order], return_inverse=True)
    total = np.bincount(place, weights=weights[order])
    mean = np.bincount(place, weights=(weights * y)[order]) / total
    rates, step = np.unique(scipy.optimize.isotonic_regression(mean, weights=total).x, return_inverse=True)
    return np.bincount(step, weights=total * levels) / np.bincount(step, weights=total), rates
