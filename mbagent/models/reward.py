"""A reward model fitted to observed rewards, for environments whose reward function is not available.

If decision graphs cannot separate the rewards, a network predicts them; compiled code evaluates dense networks, since a search
scores thousands of transitions per decision.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import Module, functional

from mbagent.data import TransitionBatch
from mbagent.models.dbn.reward_graphs import SAVED_CLASSES, ClassGraphs, cells_in, check_graphs, class_chances, fit_classes
from mbagent.models.neural.export import pack_layout
from mbagent.models.neural.kernels import RELU, Floats32, Layout, activate, active_columns, add_products, add_rows
from mbagent.models.neural.networks import Affine, Convolution, FactorCodec, cells_of
from mbagent.models.neural.training import one_thread
from mbagent.models.reward_changes import still_hold, triples, turn
from mbagent.spaces import PlaneLayout
from mbagent.types import Actions, Bools, Floats, Ints, States
from mbagent_envs.jit import compiled
from mbagent_envs.structs import Struct

HIDDEN = 64
"""Hidden nodes."""


class DenseReward(Module):
    """One hidden layer over state, action and next state."""

    def __init__(self, codec: FactorCodec, n_out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.codec = codec
        self.first = Affine(codec.n_inputs + codec.n_state_columns, HIDDEN, generator)
        self.out = Affine(HIDDEN, n_out, generator)

    def forward(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Class logits or a normalised reward [B, n_out]."""
        after = self.codec.inputs(next_states, actions)[:, : self.codec.n_state_columns]
        hidden = functional.relu(self.first(torch.cat((self.codec.inputs(states, actions), after), dim=1)))
        result: Tensor = self.out(hidden)
        return result


class RewardWeights(Struct):
    """The weights of a ``DenseReward`` for compiled code.

    Attributes:
        layout: of the input columns.
        first: from columns of state, action and next state, [n, H].
        bias: of the hidden nodes, [H].
        last: to the outputs, padded to a multiple of four rows, [4 * m, H].
        last_bias: of the outputs, likewise padded, [4 * m].
        n_outputs: number of outputs without padding.
    """

    layout: Layout
    first: Floats32
    bias: Floats32
    last: Floats32
    last_bias: Floats32
    n_outputs: int


def pack_reward(network: DenseReward) -> RewardWeights:
    """The current weights of a network."""
    with torch.no_grad():
        first, bias = network.first.weight.numpy(), network.first.bias.numpy()
        last, last_bias = network.out.weight.numpy(), network.out.bias.numpy()
        more = -len(last) % 4
        return RewardWeights(
            pack_layout(network.codec),
            np.ascontiguousarray(first.T),
            bias.copy(),
            np.pad(last, ((0, more), (0, 0))),
            np.pad(last_bias, (0, more)),
            len(last),
        )


@compiled
def _outputs(weights: RewardWeights, states: Ints, actions: Ints, next_states: Ints, out: Floats32) -> None:
    layout = weights.layout
    room, n_inputs = states.shape[1] + layout.n_steps, layout.n_state_columns + layout.n_steps * layout.n_actions
    columns, following = np.empty(2 * room, dtype=np.int64), np.empty(room, dtype=np.int64)
    hidden = np.empty((1, len(weights.bias)), dtype=np.float32)
    for b in range(len(states)):
        n = active_columns(states, b, actions[b], layout, columns)
        n_next = active_columns(next_states, b, actions[b], layout, following) - layout.n_steps
        for i in range(n_next):
            columns[n + i] = n_inputs + following[i]
        hidden[0] = weights.bias
        add_rows(weights.first, columns, n + n_next, hidden, 0)
        activate(hidden, 0, hidden.shape[1], RELU)
        out[b] = weights.last_bias
        add_products(hidden, 1, hidden.shape[1], weights.last, out[b : b + 1])


def reward_outputs(weights: RewardWeights, states: States, actions: Actions, next_states: States) -> Floats:
    """Outputs of the network, float64 [M, n_outputs]; those of a row do not depend on the other rows."""
    out = np.empty((len(states), len(weights.last_bias)), dtype=np.float32)
    rows = [np.ascontiguousarray(part, dtype=np.int64) for part in (states, actions, next_states)]
    _outputs(weights, rows[0], rows[1], rows[2], out)
    return out[:, : weights.n_outputs].astype(np.float64)


MAX_CLASSES = 64
"""Up to this many distinct rewards are predicted by classification, more by regression."""

MAX_GRAPHS = 16
"""Up to this many distinct rewards are predicted by decision graphs, unless a network does better."""

TRAINING_STEPS, BATCH, LEARNING_RATE = 1500, 256, 0.01

FLOOR = 0.01
"""A network's probabilities of rewards below this are set to 0, unless that increases the error on the training data."""

HELD_OUT = 0.15
"""Share of episodes held out in the first fit."""

_CHUNK = 256

CLEARLY_BETTER = 3.0
"""Difference of held-out log-likelihoods, in nats, from which graphs or a network are clearly better."""

FEWEST_MISSED = 4
"""Minimum number of episodes with rewards that graphs miss, for a test of whether a network predicts half from the others."""

LEAST_PROBABILITY = 1e-4
"""Probabilities below this count as this much in comparisons."""


CONTRARY, WRONG = 0.02, 0.1
"""Shares of transitions with contradictory rewards, and of held-out ones with wrong predictions, above which advice is given."""


@dataclass(frozen=True)
class RewardReport:
    """Quality of the predicted rewards.

    Attributes:
        n_values: number of distinct observed rewards.
        right: share of transitions whose reward is the predicted mean, within 0.5% of the range of rewards, or the most probable
            one.
        held_out: the same for the episodes held out in the first fit, as measured then; NaN if there are none.
        contrary: share of transitions whose reward is not the commonest among indistinguishable ones: those with the same
            observation, action and next observation, or the same prediction of decision graphs.
        since: number of transitions before the last change of rewards; 0 if there was none. The other figures refer to the
            transitions whose rewards are still valid.
    """

    n_values: int
    right: float
    held_out: float
    contrary: float
    since: int = 0

    @property
    def advice(self) -> str | None:
        """Advice for the user, in one sentence; None if there is no problem."""
        if self.since:
            return (
                f"The environment's rewards changed after about {self.since:,} steps, so the agent plans with those observed "
                "since then; when you change rewards, give the new goal with set_reward(fn), or call set_env(env), after which "
                "earlier rewards are ignored."
            )
        if self.contrary > CONTRARY:
            return (
                f"{self.contrary:.1%} of rewards differ from what the same observation, action and next observation earned "
                "otherwise, as far as the reward was found to depend on them; so it is random or depends on something unobserved "
                "(time, history), and the agent plans with mean rewards. mbagent.wrappers.History may add what is missing."
            )
        if self.held_out < 1.0 - WRONG:
            return (
                f"The learned reward is right in only {self.held_out:.1%} of the transitions of held-out episodes: learn from "
                "more steps, or give the agent a reward function (set_reward)."
            )
        return None


class LearnedReward:
    """Predicts the reward of (state, action, next state), by decision graphs or, if it predicts better, by a network.

    Args:
        cardinalities: number of values of each state factor.
        n_actions: number of enumerated actions.
        planes: layout of the factors if they form planes, else None.
        seed: of weights and batches.
        parts: number of values of each action component; None: actions have no components.
    """

    def __init__(
        self,
        cardinalities: tuple[int, ...],
        n_actions: int,
        planes: PlaneLayout | None = None,
        seed: int = 0,
        parts: Sequence[int] | None = None,
    ) -> None:
        """See the class."""
        self._codec, self._planes, self._seed = FactorCodec(cardinalities, n_actions), planes, seed
        self._parts = (n_actions,) if parts is None else tuple(parts)
        self._values = np.zeros(1)
        self._classes, self._floor = True, FLOOR
        self._graphs: ClassGraphs | None = None
        self._order = np.zeros(1)
        self._build()

    def _build(self) -> None:
        generator = torch.Generator().manual_seed(self._seed)
        n_out = len(self._values) if self._classes else 1
        self._network: nn.Module
        if self._planes is not None:
            self._network = _PlaneReward(self._codec, self._planes, n_out, generator)
        else:
            self._network = DenseReward(self._codec, n_out, generator)
        self._compile()

    @one_thread()
    def fit(self, rows: TransitionBatch) -> RewardReport:
        """Fits the model to rows, in the order observed; if rewards changed, only to rows still valid."""
        report = self._learn(rows)
        if report.right < 1.0 or report.held_out < 1.0:  # else no rows contradict each other
            since, hold = self._changed(rows)
            if since:
                report = replace(self._learn(rows.select(hold)), since=since)
        return report

    def _learn(self, rows: TransitionBatch) -> RewardReport:
        """Fits the model to most episodes, tests it on the held-out ones, then fits it to all."""
        values = np.unique(rows.rewards)
        self._classes = len(values) <= MAX_CLASSES
        self._values = values if self._classes else np.array([values.mean(), max(values.std(), 1e-6)])
        self._graphs = None
        self._build()
        held_out, clearly, (distinct, weights) = float("nan"), False, _distinct(rows)
        if len(values) > 1:
            episodes = np.unique(rows.episodes)
            chosen = np.random.default_rng(self._seed).permutation(episodes)[: int(HELD_OUT * len(episodes))]
            held = np.isin(rows.episodes, chosen)
            if held.any():
                held_out, gain = self._choose(rows, held)
                if abs(gain) <= CLEARLY_BETTER:  # rare rewards may be missing in the test rows
                    missed = self._half_of_missed(rows)
                    gain = self._choose(rows, missed)[1] if missed.any() else gain
                clearly = gain > CLEARLY_BETTER
            if self._graphs is not None or not held.any():
                self._graphs = self._as_graphs(rows)
            trained = held.any() and self._graphs is None
            if self._graphs is not None and not clearly:
                misses = self._missed(rows).any() or (not held.any() and self._share_right(distinct, weights) < 1.0)
                self._graphs = None if misses else self._graphs
            if self._graphs is None:
                self._train(distinct, torch.from_numpy(weights), TRAINING_STEPS // 2 if trained else TRAINING_STEPS)
        right = self._share_right(distinct, weights)
        contrary = _contrary_share(rows)
        if self._graphs is not None:
            chances = self._graph_chances(rows.states, rows.actions, rows.next_states)
            contrary = max(contrary, _contrary_share(rows, np.unique(chances, axis=0, return_inverse=True)[1].ravel()))
        return RewardReport(len(values), right, held_out, contrary)

    def _choose(self, rows: TransitionBatch, held: Bools) -> tuple[float, float]:
        """Fits graphs and, unless they are perfect, a network; keeps the one that predicts the held-out rows better.

        Graphs need evidence for a split, so they may miss a reward that was observed once or twice; if the held-out rows show no
        clear difference, the number of such misses decides.

        Returns:
            (share of held-out rows with the right reward, held-out log-likelihood of graphs minus that of the network, infinite
            if only one of them was fitted).
        """
        train, tests = rows.select(np.flatnonzero(~held)), rows.select(np.flatnonzero(held))
        graphs = self._graphs = self._as_graphs(train)
        if graphs is None:
            self._train_on(train)
            return self._share_right(tests), -math.inf
        missed, logs, right = self._missed(train).sum(), self._log_likelihood(tests), self._share_right(tests)
        if right == 1.0 and missed == 0:
            return right, math.inf
        self._graphs = None
        self._train_on(train)
        gain, fewer_misses = logs - self._log_likelihood(tests), missed <= self._missed(train).sum()
        # Test rows hardly distinguish means of random rewards, and those of graphs are the means of the training rows.
        least = -CLEARLY_BETTER if _contrary_share(train) > 0.0 else 0.0
        if gain > CLEARLY_BETTER or (gain >= least and fewer_misses):
            self._graphs = graphs
            return right, gain
        return self._share_right(tests), gain

    def _half_of_missed(self, rows: TransitionBatch) -> Bools:
        """Rows, in every second episode, with rewards graphs miss, bool [N]; none if graphs miss few."""
        before, self._graphs = self._graphs, self._as_graphs(rows)
        episodes = np.unique(rows.episodes[self._missed(rows)])
        self._graphs = before
        return np.isin(rows.episodes, episodes[::2] if len(episodes) >= FEWEST_MISSED else [])

    def _train_on(self, rows: TransitionBatch) -> None:
        distinct, weights = _distinct(rows)
        self._train(distinct, torch.from_numpy(weights), TRAINING_STEPS)

    def _missed(self, rows: TransitionBatch) -> Bools:
        """Which rows [N] have a non-default reward that is predicted as the default.

        Their rewards are averaged over all rows with the same observation, action and next observation, which cannot be
        distinguished.
        """
        off, numbers = self._order[0], _triple_indices(rows)
        means = (np.bincount(numbers, weights=rows.rewards) / np.bincount(numbers))[numbers]
        away = np.abs(means - off)
        predicted = np.abs(self(rows.states, rows.actions, rows.next_states) - off)
        missed: Bools = (predicted < 0.5 * away) & (away > 1e-9 * np.ptp(self._values))
        return missed

    def _as_graphs(self, rows: TransitionBatch) -> ClassGraphs | None:
        """Decision graphs for the rewards of some rows; None if there are too many distinct ones."""
        if not self._few:
            return None
        graphs, order = self._class_graphs(rows)
        self._order = self._values[order]
        return graphs

    @property
    def _few(self) -> bool:
        """Whether there are few enough rewards for graphs."""
        return self._classes and len(self._values) <= MAX_GRAPHS

    def _class_graphs(self, rows: TransitionBatch) -> tuple[ClassGraphs, NDArray[np.int64]]:
        """Decision graphs for the rewards of some rows, and the index of each class's reward, the commonest first."""
        number = np.searchsorted(self._values, rows.rewards)
        common = int(np.bincount(number, minlength=len(self._values)).argmax())
        order = np.concatenate([[common], np.delete(np.arange(len(self._values)), common)])
        return fit_classes(rows, np.argsort(order)[number], self._codec.cardinalities, self._parts, self._planes), order

    def _probabilities(self, train: TransitionBatch, rows: TransitionBatch) -> Floats:
        """Probability [N, K] of each reward of ``rows``, as predicted by graphs fitted to ``train``."""
        graphs, order = self._class_graphs(train)
        parts = (np.ascontiguousarray(part) for part in (rows.states, rows.actions, rows.next_states))
        return class_chances(graphs, len(order), *parts)[:, np.argsort(order)]

    # ------------------------------------------------------------------ changes

    def _changed(self, rows: TransitionBatch) -> tuple[int, NDArray[np.int64]]:
        """Number of rows before the last change of rewards, 0 if there was none, and indices of the rows that are still valid."""
        order = np.argsort(rows.episodes, kind="stable")  # episode by episode, since episodes of several environments alternate
        rows = rows.select(order)
        keys, values, since = triples(rows), self._numbers(rows.rewards), 0
        while found := self._change_point(rows.select(slice(since, None)), keys[since:], values[since:]):
            since += found
        if not since:
            return 0, order
        hold = np.arange(len(rows)) >= since
        if self._few:  # older rows not observed again are still valid, unless similar transitions have another reward now
            old, new = (self._probabilities(rows.select(part), rows) for part in (~hold, hold))
            cells = np.unique(np.concatenate([old, new], axis=1), axis=0, return_inverse=True)[1].ravel()
            hold[:since] = still_hold(cells, values, since) & ~np.isin(keys[:since], keys[since:])
        return since, np.sort(order[hold])

    def _numbers(self, rewards: NDArray[np.float64]) -> NDArray[np.int64]:
        """Index of each reward among the distinct ones; if there are very many, of its quantile range."""
        if self._classes:
            return np.searchsorted(self._values, rewards)
        return np.searchsorted(np.quantile(rewards, np.arange(1, MAX_GRAPHS) / MAX_GRAPHS), rewards)

    def _change_point(self, rows: TransitionBatch, keys: NDArray[np.int64], values: NDArray[np.int64]) -> int:
        """First row whose rewards differ from earlier ones, or 0."""
        found = turn(keys, values, rows.episodes)
        half = len(rows) // 2
        if found or not self._few or np.isin(keys[half:], keys[:half]).mean() > 0.5:
            return found
        # If transitions are hardly ever repeated, those with the same prediction of graphs are grouped. Since a covariate shift
        # could then look like a change, a fit to the rows after it must also predict better than one to all rows.
        probabilities = self._probabilities(rows, rows)
        found = turn(np.unique(probabilities, axis=0, return_inverse=True)[1].ravel(), values, rows.episodes)
        if not found:
            return 0
        tested = (np.arange(len(rows)) >= found) & (np.arange(len(rows)) % 3 == 0)
        tests, known = rows.select(tested), [~tested, ~tested & (np.arange(len(rows)) >= found)]
        errors = [(self._probabilities(rows.select(train), tests) @ self._values - tests.rewards) ** 2 for train in known]
        gain = errors[0] - errors[1]
        return found if gain.mean() > 2.0 * gain.std() / len(gain) ** 0.5 else 0

    def _log_likelihood(self, rows: TransitionBatch) -> float:
        """Log-probability of the rewards of all rows, predicted as classes."""
        own = self._chances(rows)[np.arange(len(rows)), np.searchsorted(self._values, rows.rewards)]
        return float(np.log(np.maximum(own, LEAST_PROBABILITY)).sum())

    def _chances(self, rows: TransitionBatch) -> Floats:
        """Probability of each distinct reward, ascending, [N, K]."""
        if self._graphs is not None:
            return self._graph_chances(rows.states, rows.actions, rows.next_states)[:, np.argsort(self._order)]
        chances: Floats = self._outputs(rows.states, rows.actions, rows.next_states).double().softmax(dim=1).numpy()
        return chances

    def _graph_chances(self, states: States, actions: Actions, next_states: States) -> Floats:
        """Probability of each reward, in the order of ``_order``, [M, K], from the graphs."""
        assert self._graphs is not None
        arrays = (np.ascontiguousarray(part, dtype=np.int64) for part in (states, actions, next_states))
        chances: Floats = class_chances(self._graphs, len(self._order), *arrays)
        return chances

    def _share_right(self, rows: TransitionBatch, weights: NDArray[np.float32] | None = None) -> float:
        """Share of rows whose reward is the predicted mean or the most probable one."""
        value_range = float(np.ptp(self._values)) if self._classes else 6.0 * float(self._values[1])
        right = np.abs(self(rows.states, rows.actions, rows.next_states) - rows.rewards) <= 0.005 * max(value_range, 1e-12)
        if self._classes and len(self._values) > 1:
            right |= self._values[self._chances(rows).argmax(axis=1)] == rows.rewards
        return float(np.average(right, weights=weights))

    def _train(self, rows: TransitionBatch, weights: Tensor, steps: int) -> None:
        states, actions, next_states = (torch.from_numpy(part) for part in (rows.states, rows.actions, rows.next_states))
        if self._classes:
            targets = torch.from_numpy(np.searchsorted(self._values, rows.rewards))
        else:
            targets = torch.from_numpy((rows.rewards - self._values[0]) / self._values[1]).float()
        generator = torch.Generator().manual_seed(self._seed + 1)
        optimizer = torch.optim.Adam(self._network.parameters(), lr=LEARNING_RATE)
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * min(1.0, 2.0 * (1.0 - step / steps))
            i = torch.randint(len(actions), (min(BATCH, len(actions)),), generator=generator)
            out = self._network(states[i], actions[i], next_states[i])
            if self._classes:
                losses = functional.cross_entropy(out, targets[i], reduction="none")
            else:
                losses = (out[:, 0] - targets[i]) ** 2
            optimizer.zero_grad(set_to_none=True)
            (losses * weights[i]).mean().backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        self._compile()
        if self._classes:
            errors = []
            for self._floor in (0.0, FLOOR):
                predicted = self(rows.states, rows.actions, rows.next_states)
                errors.append(float((weights.double().numpy() * (predicted - rows.rewards) ** 2).sum()))
            self._floor = FLOOR if errors[1] <= errors[0] else 0.0

    def _compile(self) -> None:
        """Packs the current weights for compiled code, if there is a kernel for the network."""
        self._packed = pack_reward(self._network) if isinstance(self._network, DenseReward) else None

    @one_thread()
    def __call__(self, states: States, actions: Actions, next_states: States) -> Floats:
        """Expected rewards float64 [M]; those of a row do not depend on the other rows."""
        if len(self._values) == 1:
            return np.full(len(actions), self._values[0])
        if self._graphs is not None:
            return _expected_values(self._graph_chances(states, actions, next_states), self._order)
        return self._expected(self._outputs(states, actions, next_states)).numpy()

    @torch.inference_mode()
    def _outputs(self, states: States, actions: Actions, next_states: States) -> Tensor:
        """Outputs of the network [M, n_out]; those of a row do not depend on the other rows."""
        if self._packed is not None:
            return torch.from_numpy(reward_outputs(self._packed, states, actions, next_states))
        parts = [torch.zeros((0, len(self._values) if self._classes else 1))]
        for start in range(0, len(actions), _CHUNK):
            rows = [np.ascontiguousarray(part[start : start + _CHUNK]) for part in (states, actions, next_states)]
            n = len(rows[1])
            # Always the same size, since the rounding of matrix products depends on it.
            padded = [np.concatenate([part, np.zeros((_CHUNK - n, *part.shape[1:]), part.dtype)]) for part in rows]
            parts.append(self._network(*(torch.from_numpy(part) for part in padded))[:n])
        return torch.cat(parts)

    def _expected(self, out: Tensor) -> Tensor:
        if not self._classes:
            return out[:, 0].double() * float(self._values[1]) + float(self._values[0])
        return torch.from_numpy(_expected_values(out.double().softmax(dim=1).numpy(), self._values, self._floor))

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """All weights, as arrays."""
        known = {"values": self._values.copy(), "classes": np.array(self._classes), "floor": np.array(self._floor)}
        if self._graphs is not None:
            graphs = {f"graphs.{name}": array.copy() for name, array in zip(SAVED_CLASSES, self._graphs, strict=True)}
            return {**known, "order": self._order.copy(), **graphs}
        return known | {f"network.{name}": value.numpy().copy() for name, value in self._network.state_dict().items()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restores the weights that ``state_dict`` returned.

        Raises:
            ValueError: the arrays do not belong to a reward model of this environment.
        """
        self._values, self._classes = np.array(state["values"]), bool(state["classes"])
        self._floor = float(state.get("floor", FLOOR))  # files of earlier versions have none
        self._graphs = None
        self._build()
        if "order" in state:
            self._order = np.array(state["order"], dtype=np.float64).reshape(-1)
            own = {name.removeprefix("graphs."): array for name, array in state.items() if name.startswith("graphs.")}
            cards, n_actions = self._codec.cardinalities, self._codec.n_actions
            self._graphs = check_graphs(own, cards, n_actions, len(self._order), cells_in(self._planes, len(cards)))
            return
        prefix = "network."
        weights = {k.removeprefix(prefix): torch.tensor(np.asarray(v)) for k, v in state.items() if k.startswith(prefix)}
        self._network.load_state_dict(weights)
        self._compile()


class _PlaneReward(nn.Module):
    """A convolution over the planes of both states, whose features are pooled by maximum and mean."""

    def __init__(self, codec: FactorCodec, layout: PlaneLayout, n_out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.codec, self.layout, channels = codec, layout, 16
        n_planes = layout.channels * (1 if codec.all_binary else codec.width)
        self.first = Convolution(2 * n_planes + 1, channels, 3, generator)
        self.action = Affine(codec.n_actions, channels, generator)
        self.second = Affine(2 * channels, 32, generator)
        self.out = Affine(32, n_out, generator)

    def forward(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Class logits or a normalised reward [B, n_out]."""
        before, after = (cells_of(part, self.layout, self.codec) for part in (states, next_states))
        ones = torch.ones_like(before[:, :1])
        action = self.action(functional.one_hot(actions, self.codec.n_actions).to(before.dtype))
        hidden = functional.relu(self.first(torch.cat((before, after, ones), dim=1)) + action[:, :, None, None])
        pooled = torch.cat((hidden.amax(dim=(2, 3)), hidden.mean(dim=(2, 3))), dim=1)
        result: Tensor = self.out(functional.relu(self.second(pooled)))
        return result


def _distinct(rows: TransitionBatch) -> tuple[TransitionBatch, NDArray[np.float32]]:
    """Distinct (s, a, s', r), each weighted by its share of the rows with that (s, a, s').

    So rare transitions weigh as much as frequent ones, and random rewards keep their distribution.
    """
    keys, bits = triples(rows), np.ascontiguousarray(rows.rewards).view(np.int64)
    _, first, counts = np.unique(np.stack([keys, bits], axis=1), axis=0, return_index=True, return_counts=True)
    _, inverse = np.unique(keys[first], return_inverse=True)
    shares = counts / np.bincount(inverse, weights=counts)[inverse]
    return rows.select(first), shares.astype(np.float32)


def _expected_values(probabilities: Floats, values: Floats, floor: float = 0.0) -> Floats:
    """Expected values [M] under probabilities [M, K]; those below ``floor`` are set to 0."""
    p = np.where(probabilities < floor, 0.0, probabilities)
    # Not a matrix product, whose rounding would depend on the number of rows.
    expected: Floats = (p / p.sum(axis=1, keepdims=True) * values).sum(axis=1)
    return expected


def _triple_indices(rows: TransitionBatch) -> NDArray[np.int64]:
    """Index 0, 1, ... of each row's (s, a, s') among the distinct ones, int64 [N]."""
    result: NDArray[np.int64] = np.unique(triples(rows), return_inverse=True)[1]
    return result


def _contrary_share(rows: TransitionBatch, keys: Ints | None = None) -> float:
    """Share of rows whose reward is not the commonest one of those with the same key [N]; by default (s, a, s')."""
    keys = triples(rows) if keys is None else keys
    bits = np.ascontiguousarray(rows.rewards + 0.0, dtype=np.float64).view(np.int64)  # -0.0 is 0.0
    pairs, counts = np.unique(np.stack([keys, bits], axis=1), axis=0, return_counts=True)
    first = np.flatnonzero(np.r_[True, pairs[1:, 0] != pairs[:-1, 0]])
    return 1.0 - float(np.maximum.reduceat(counts, first).sum()) / len(rows.actions)
