"""How far a model can be trusted: the probability that what it foretells is wrong (the paper's section 6, model error).

A model knows how random the world is, not how wrong it may be itself. Models learned without one part of the episodes or
another disagree where there is little to go by (the jackknife); how often predictions with so much doubt were wrong
on episodes held out, each part in turn, makes an honest probability of it (isotonic regression; Zadrozny and Elkan 2002).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.protocol import TransitionModel
from mbagent.types import Actions, Bools, Floats, Ints, States

BELIEVED = 20.0
"""Held-out transitions that a doubt counts for as it stands."""


_AS_IT_STANDS = np.array([0.0, 1.0]), np.array([0.0, 1.0])


@dataclass(frozen=True)
class ModelError:
    """The estimated error of a model.

    Attributes:
        model: the model.
        members: models of its data without one part or another.
        doubts: doubts with known errors, ascending, [K].
        rates: how often predictions with such a doubt are wrong, [K].
    """

    model: TransitionModel
    members: tuple[TransitionModel, ...]
    doubts: Floats
    rates: Floats

    def __call__(self, states: States, actions: Actions) -> Floats:
        """Probability that the likeliest next state is not what comes, by chance or by error, [B]."""
        return np.interp(self.doubt(states, actions), self.doubts, self.rates)

    def doubt(self, states: States, actions: Actions) -> Floats:
        """Probability of anything else than the model's likeliest outcome, mean over the model and all members, [B]."""
        following, ends = likeliest(self.model, states, actions)
        logs = [model.log_prob(states, actions, following, ends) for model in (self.model, *self.members)]
        result: Floats = 1.0 - np.exp(logs).mean(axis=0)
        return result.clip(0.0, 1.0)

    def disagreement(self, states: States, actions: Actions) -> Floats:
        """Standard deviation, over the models, of the probability of the likeliest outcome, [B]: what more data would settle."""
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
    """Learns how wrong a model may be.

    Args:
        build: makes a new model of its kind.
        model: the model, fitted to ``data``; it needs exact probabilities.
        data: what it was fitted to.
        n_members: models to hold beside it, each fitted to all but one of as many parts of the episodes; one more is fitted
            for every two parts, without both, to learn how often the members are wrong: 15 fits in all for 5.
        seed: of fits and parts.

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
        fewer = tuple(other for pair, other in without.items() if number in pair)
        held_out = rows.select(part == number)
        doubts.append(ModelError(member, fewer, *_AS_IT_STANDS).doubt(held_out.states, held_out.actions))
        wrong.append(missed(member, held_out))
    return ModelError(model, members, *_calibrated(np.concatenate(doubts), np.concatenate(wrong)))


def _check_probabilities(model: TransitionModel, row: TransitionBatch) -> None:
    """Refuses a model without exact probabilities before anything is fitted.

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
    """Which of ``n_parts`` parts each row is in, by whole episodes, int64 [N]; few long episodes are cut into runs first."""
    groups = np.unique(rows.episodes, return_inverse=True)[1]
    if groups.max() + 1 < 2 * n_parts:
        groups = np.arange(len(rows)) * 2 * n_parts // len(rows)
    part = np.random.default_rng(seed).permutation(groups.max() + 1) % n_parts
    result: Ints = part[groups]
    return result


def likeliest(model: TransitionModel, states: States, actions: Actions) -> tuple[States, Bools]:
    """A model's likeliest next states, int64 [B, F], and ends, bool [B]: its own word, or each factor's likeliest value."""
    own = getattr(model, "likeliest", None)
    if own is not None:
        found: tuple[States, Bools] = own(states, actions)
        return found
    probs, start = model.marginals(states, actions), np.concatenate([[0], np.cumsum(model.cardinalities)])
    columns = [probs[:, begin:end].argmax(axis=1) for begin, end in itertools.pairwise(start)]
    following = np.stack(columns, axis=1).astype(np.int64)
    logs = [model.log_prob(states, actions, following, np.full(len(states), end)) for end in (False, True)]
    return following, logs[1] > logs[0]


def missed(model: TransitionModel, rows: TransitionBatch) -> Bools:
    """In which rows the likeliest outcome is not what came, bool [N]."""
    following, ends = likeliest(model, rows.states, rows.actions)
    result: Bools = (following != rows.next_states).any(axis=1) | (ends != rows.terminated)
    return result


def _calibrated(doubts: Floats, wrong: Bools) -> tuple[Floats, Floats]:
    """Doubts and how often they were wrong, ascending; with few held-out transitions a doubt is believed as it stands.

    Doubts of one rate stand at their mean, so that between them more doubt is more (Oron and Flournoy 2017).
    """
    own = np.quantile(doubts, np.linspace(0.0, 1.0, 11)) if len(doubts) else np.zeros(0)
    x = np.concatenate([doubts, own, [0.0, 1.0]])
    y = np.concatenate([wrong.astype(np.float64), own, [0.0, 1.0]])
    weights = np.concatenate([np.ones(len(doubts)), np.full(len(own), BELIEVED / 13.0), np.full(2, BELIEVED / 13.0)])
    order = np.argsort(x, kind="stable")
    levels, place = np.unique(x[order], return_inverse=True)
    total = np.bincount(place, weights=weights[order])
    mean = np.bincount(place, weights=(weights * y)[order]) / total
    rates, step = np.unique(isotonic_regression(mean, weights=total).x, return_inverse=True)
    return np.bincount(step, weights=total * levels) / np.bincount(step, weights=total), rates
