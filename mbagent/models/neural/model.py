"""The learned model of the paper's section 3: a predictor network and a conditioner network."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np
import torch

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.fit_report import FitReport
from mbagent.models.neural.connections import PruningConfig, check_fraction
from mbagent.models.neural.export import CompiledBody, as_rows, compiled_body, pack_groups
from mbagent.models.neural.gibbs import sample_sweeps
from mbagent.models.neural.kernels import GroupWeights, Rows, probabilities
from mbagent.models.neural.network_pair import NO_MARKS, NetworkPair
from mbagent.models.neural.networks import DensePredictor
from mbagent.models.neural.pruning import VariableGroup, dependent_groups, influence, modules, prune_networks
from mbagent.models.neural.sampling import (
    causal_successors,
    independent_successors,
    log_prob_causal,
    sample_causal,
    sample_independent,
)
from mbagent.models.neural.training import Examples, Trainer, as_examples, examples, one_thread
from mbagent.models.neural.truth_tables import BitRules, Pair, compile_rules, find_parents, sample_rules, tabulable, tabulate
from mbagent.models.protocol import Successors, as_keys
from mbagent.types import Actions, Bools, Floats, Randomness, States

PrunedAs: TypeAlias = Literal["tables", "matrices"]


class NeuralTransitionModel(NetworkPair):
    """A predictor network, alone or with a conditioner network. Arguments are those of NetworkPair.

    Attributes:
        pruned_as: how a pruned model of bits is sampled. "tables": from truth tables if all bits have few inputs left, else as
            "matrices"; "matrices": from the dense weight matrices, as before pruning.
    """

    pruned_as: PrunedAs = "tables"

    def _changed(self) -> None:
        self._forward: CompiledBody | None = None
        self._groups: GroupWeights | None = None
        self._rules: dict[float, tuple[BitRules, BitRules]] = {}

    @one_thread()
    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel; starts from initial weights that depend only on ``seed``, not on earlier fits.

        The alternative of continuing from the weights of an earlier fit was measured: it takes half the time or less, but
        its loss is 0.001 to 0.003 nats per transition higher, and depends on the earlier fits.

        The predictor is fitted first; then the conditioner, with groups for the factors of which the predictor is uncertain.
        """
        began = time.perf_counter()
        generator = self._build(seed)
        train_rows, held_out_rows = data.split(self.config.training.validation, seed)
        train, held_out = examples(train_rows), examples(held_out_rows)
        trainer = Trainer(self.codec, self.predictor, None, self.config.training)
        half = progress if progress is None or self.conditioner is None else lambda share: progress(0.5 * share)
        epochs = trainer.fit(train, held_out, generator, half)
        if self.conditioner is not None:
            grouped = trainer.open_factors(held_out)
            self.conditioner = trainer.conditioner = self._new_conditioner(grouped, generator)
            half = None if progress is None else lambda share: progress(0.5 + 0.5 * share)
            epochs += trainer.fit_conditioner(train, held_out, generator, half)
        self._changed()
        return self._report(trainer, (train_rows, held_out_rows), (train, held_out), epochs, began)

    @one_thread()
    def prune(
        self,
        data: TransitionDataset,
        fraction: float,
        *,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        config: PruningConfig | None = None,
    ) -> FitReport:
        """Removes the smallest weights of both networks and trains the remaining ones (paper section 5); see ``pruning``.

        Args:
            data: the transitions to which the model was fitted; with the fit's ``seed``, the same rows are held out.
            fraction: minimum share of each network's connections to remove, in [0, 1); further connections are removed if the
                data do not support them (``PruningConfig.evidence``). Connections stay removed in later calls; ``fit`` starts
                again with all connections.
            seed: seed of the held-out rows and of the batches.
            progress: called with the completed share, 0 ... 1.
            config: see PruningConfig.

        Raises:
            ValueError: a fraction outside [0, 1), or no data. After this or any other error the model is unchanged.
        """
        fraction, began, before = check_fraction(fraction), time.perf_counter(), self.state_dict()
        if not len(data):
            raise ValueError(
                "There are no transitions to train the remaining connections on: pass those that the model was fitted to."
            )
        rows = data.split(self.config.training.validation, seed)
        train, held_out = examples(rows[0]), examples(rows[1])
        trainer = Trainer(self.codec, self.predictor, self.conditioner, self.config.training)
        try:
            epochs = prune_networks(
                trainer, self.connections(), fraction, (train, held_out), len(rows[0]), seed, progress, config
            )
            pair = self._pair()
            marks = find_parents(pair, train) if pair else NO_MARKS
        except BaseException:
            self.load_state_dict(before)
            raise
        self._pruned, self._online, self._marks = True, None, marks
        self._changed()
        return self._report(trainer, rows, (train, held_out), epochs, began)

    def _report(
        self,
        trainer: Trainer,
        rows: tuple[TransitionBatch, TransitionBatch],
        distinct: tuple[Examples, Examples],
        epochs: float,
        began: float,
    ) -> FitReport:
        first, second = trainer.evaluate(distinct[1])
        connections = self.connections().values()
        return FitReport(
            n_train=len(rows[0]),
            n_validation=len(rows[1]),
            epochs=round(epochs),
            seconds=time.perf_counter() - began,
            predictor_loss=first,
            conditioner_loss=second,
            exact_match=self._exact_match(distinct[1]),
            log={
                "distinct_transitions": float(len(distinct[0])),
                "conditioned_factors": float(len(self.conditioner.members)) if self.conditioner else 0.0,
                "connections": float(sum(c.left for c in connections)),
                "pruned": 1.0 - sum(c.left for c in connections) / max(1, sum(c.total for c in connections)),
            },
        )

    def _exact_match(self, rows: Examples) -> float:
        """Weighted share of transitions whose outcome is the greedy prediction (each factor's most likely value in turn)."""
        states, actions, outcomes = rows.states.numpy(), rows.actions.numpy(), rows.outcomes.numpy()
        batch = self._rows(*as_rows(states, actions, len(self.cardinalities)))
        likeliest = batch.probs.argmax(axis=2)
        if self.config.conditioner == "causal":
            keys = np.zeros(len(states), dtype=np.uint64)
            likeliest = sample_causal(batch, keys, self._packed_groups(), self.config.certain, True)
        weights = rows.weights.numpy()
        return float(np.average((likeliest == outcomes).all(axis=1), weights=weights)) if len(weights) else 1.0

    @one_thread()
    def observe(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> None:
        """The paper's on-line method: one gradient step with each observation's own outcome as target.

        Adapts to changing dynamics, but is slower than ``fit`` and depends on the order of observations.
        """
        trainer = Trainer(self.codec, self.predictor, self.conditioner, self.config.training)
        if self._online is None:
            parameters = [p for module in self._parts().values() for p in module.parameters()]
            self._online = torch.optim.Adam(parameters, lr=self.config.training.online_learning_rate)
            self._left = self.connections()
        trainer.observe(self._online, as_examples(states, actions, next_states, terminated))
        for connections in self._left.values() if self._pruned else ():
            connections.apply()
        self._changed()

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        keys = as_keys(rng, len(states))
        states, actions = as_rows(states, actions, len(self.cardinalities))
        if (rules := self.rules()) is not None:
            return sample_rules(states, actions, keys, rules)
        rows, config = self._rows(states, actions), self.config
        if config.conditioner is None:
            factors = sample_independent(rows.probs, self._layout.outputs, keys)
        elif config.conditioner == "causal":
            factors = sample_causal(rows, keys, self._packed_groups(), config.certain, False)
        else:
            factors = sample_sweeps(rows, keys, self._packed_groups(), config.certain, config.sweeps, config.real_guess)
        return np.ascontiguousarray(factors[:, :-1]), factors[:, -1] == 1

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        probs = self.probabilities(states, actions)[:, :-1]
        possible = np.arange(self.codec.width) < np.asarray(self.cardinalities)[:, None]
        return probs[:, possible]

    def probabilities(self, states: States, actions: Actions) -> Floats:
        """The predictor's distribution of each factor, ``terminated`` last: float64 [B, O, K]; 0 beyond its cardinality."""
        return self._rows(*as_rows(states, actions, len(self.cardinalities))).probs

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel; exact for the distribution that ``sample`` draws from."""
        if self.config.conditioner == "others":
            raise NotImplementedError(
                'A conditioner with mask "others" samples by sweeps and has no exact probabilities; '
                'use NeuralConfig(conditioner="causal").'
            )
        states, actions = as_rows(states, actions, len(self.cardinalities))
        outcomes = np.concatenate([next_states, terminated[:, None]], axis=1).astype(np.int64)
        rows = self._rows(states, actions)
        if self.config.conditioner is None:
            with np.errstate(divide="ignore"):
                result: Floats = np.log(np.take_along_axis(rows.probs, outcomes[:, :, None], axis=2)[:, :, 0]).sum(axis=1)
            return result
        return log_prob_causal(rows, outcomes, self._packed_groups(), self.config.certain)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; systematic sampling (``systematic_sampling.py``) if probabilities are exact, else samples."""
        if self.config.conditioner == "others":
            return super().successors(states, actions, n_samples, seed)
        rows = self._rows(*as_rows(states, actions, len(self.cardinalities)))
        if self.config.conditioner is None:
            return independent_successors(rows.probs, self._layout.outputs, n_samples, seed)
        return causal_successors(rows, self._packed_groups(), self.config.certain, n_samples, seed)

    def kernel(self) -> BitRules | None:
        """The truth tables of pruned networks, for compiled search (see ``models.kernel``); None if there are none."""
        return self.rules(settled=True)

    def rules(self, settled: bool = False) -> BitRules | None:
        """Truth tables of a pruned model of bits, for sampling or (if ``settled``) search; None if it has or uses none."""
        if not len(self._marks) or self.pruned_as == "matrices" or not tabulable(self._marks) or (pair := self._pair()) is None:
            return None
        if self.config.certain not in self._rules:
            tables, n = tabulate(pair, self._marks), self.codec.n_actions
            self._rules[self.config.certain] = compile_rules(tables, n), compile_rules(tables, n, settled=True)
        return self._rules[self.config.certain][settled]

    def modules(self) -> list[VariableGroup]:
        """The independent groups of variables (paper section 5), largest first; see ``pruning.modules``.

        Raises:
            ValueError: the predictor is not dense, for example because its weights are shared over positions.
        """
        return modules(influence(self, effective=True))

    def dependent_groups(self) -> list[VariableGroup]:
        """Groups of variables whose next values are dependent given state and action; see ``pruning.dependent_groups``."""
        return dependent_groups(influence(self, effective=True))

    def _pair(self) -> Pair | None:
        """The networks if tabulable (only bits, single actions, dense predictor, causal or no conditioner), else None."""
        bits = self.codec.all_binary and self.codec.n_steps == 1 and self.config.conditioner != "others"
        if not bits or not isinstance(self.predictor, DensePredictor):
            return None
        return Pair(self.predictor, self.conditioner, self.config.certain)

    def _packed_groups(self) -> GroupWeights:
        if self._groups is None:
            assert self.conditioner is not None
            self._groups = pack_groups(self.conditioner)
        return self._groups

    def _rows(self, states: States, actions: Actions) -> Rows:
        """A batch with the predictor's results."""
        if self._forward is None:
            self._forward = compiled_body(self.predictor)
        logits = self._forward(states, actions)
        return Rows(states, actions, logits, probabilities(logits, self._layout.outputs))
