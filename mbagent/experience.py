"""From the steps of a vector environment to transitions; no reset is ever taken for one."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Actions, States, hash_rows
from mbagent.policies import one_as_batch
from mbagent.spaces import FactoredSpace
from mbagent.transitions import TransitionBatch, TransitionDataset
from mbagent.wrapping import blaming_environment

_FLUSH = 256

CHANCE = 1e-3
"""Episodes that all end where the next one starts are reported from this probability on that they do by chance."""


class Experience:
    """All transitions met, with the values of open factors (see FactoredSpace) as declared, so that none is ever lost.

    Args:
        space: the observation space, without ``values``.
        n_actions: number of enumerated actions A.

    Attributes:
        dataset: the transitions, numbered as declared.
    """

    def __init__(self, space: FactoredSpace, n_actions: int) -> None:
        """See the class."""
        self.space, self.dataset = space, TransitionDataset(space.cardinalities, n_actions)
        self._coded: tuple[FactoredSpace, int, TransitionDataset] | None = None

    def coding(self) -> FactoredSpace:
        """The space whose open factors are the values met so far, before or after a step.

        Raises:
            ValueError: a variable took too many values.
        """
        if not len(self.space.open):
            return self.space
        rows = self.dataset.rows()
        return self.space.with_values(np.concatenate([rows.before, rows.after]))

    def coded(self, space: FactoredSpace) -> TransitionDataset:
        """The transitions in the factors of ``space``; the dataset itself where no factor is open."""
        if space.values is None or not len(space.open):
            return self.dataset
        n_met = len(self.dataset)
        if self._coded is None or self._coded[0] is not space or self._coded[1] != n_met:
            rows, coded = self.dataset.rows(), TransitionDataset(space.cardinalities, self.dataset.n_actions)
            coded.append(replace(rows, before=space.narrow(rows.states), after=space.narrow(rows.next_states)))
            self._coded = (space, n_met, coded)
        return self._coded[2]


class ExperienceRecorder:
    """Collects the steps of ``n_envs`` environments that reset themselves, as SB3's VecEnv do.

    Args:
        space: the observation space, without ``values``.
        dataset: where transitions go.
        n_envs: number of environments B.

    Attributes:
        states: int64 [B, F], the current state of every environment; None before ``reset``.
    """

    def __init__(self, space: FactoredSpace, dataset: TransitionDataset, n_envs: int) -> None:
        """See the class."""
        self._space, self._dataset = space, dataset
        self._steps: list[TransitionBatch] = []
        self._starts: list[States] = []
        self._ends_at_starts = True
        rows = dataset.rows().episodes
        self._next_episode = int(rows.max()) + 1 if len(rows) else 0
        self._episodes = np.zeros(n_envs, dtype=np.int64)
        self.states: States | None = None

    def reset(self, obs: Any) -> None:
        """Every environment starts a new episode at ``obs`` (batched)."""
        with blaming_environment():
            self.states = self._space.encode(obs)
        self._begin(np.arange(len(self.states)))

    def _begin(self, which: NDArray[np.int64]) -> None:
        assert self.states is not None
        self._episodes[which] = self._next_episode + np.arange(len(which))
        self._next_episode += len(which)
        self._starts.append(self.states[which])

    def record(
        self,
        actions: Actions,
        new_obs: Any,
        rewards: NDArray[Any],
        dones: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> TransitionBatch:
        """Adds one step of every environment, and returns it, [B].

        Args:
            actions: int64 [B], numbers of the enumerated actions.
            new_obs: what the vector environment returned: where an episode ended, already the next one's first.
            rewards: float [B].
            dones: bool [B].
            infos: SB3's: the true last observation is in ``terminal_observation``, a truncation in
                ``TimeLimit.truncated``.
        """
        assert self.states is not None
        if not np.isfinite(rewards).all():
            raise ValueError(
                "The environment returned a reward of NaN or infinity, or one beyond 3.4e38, which is more than the float32 of "
                "vector environments can hold; mend the environment or wrap its rewards."
            )
        ended, terminated = np.flatnonzero(dones), np.array(dones, dtype=np.bool_)
        with blaming_environment():
            following = self._space.encode(new_obs)
            next_states = following.copy() if len(ended) else following
            for i in ended:
                last = infos[i].get("terminal_observation")
                if last is None:
                    raise ValueError(
                        f"The vector environment ended an episode without infos[{i}]['terminal_observation'], as SB3's have it; "
                        "add it, or make the environment's step return a new info dict each time."
                    )
                next_states[i] = self._space.encode(one_as_batch(self._space.space, last))[0]
                terminated[i] = not infos[i].get("TimeLimit.truncated", False)
        step = TransitionBatch(
            self.states,
            actions.astype(np.int64),
            next_states,
            terminated,
            np.array(rewards, dtype=np.float64),  # copied: the vector environment may use its arrays again
            self._episodes.copy(),
        )
        self._steps.append(step)
        self.states = following
        if len(ended):
            self._ends_at_starts &= np.array_equal(next_states[ended], following[ended])
            self._begin(ended)
        if len(self._steps) >= _FLUSH:
            self.flush()
        return step

    def flush(self) -> None:
        """Hands what was collected to the dataset."""
        if self._steps:
            names = ("states", "actions", "next_states", "terminated", "rewards", "episodes")
            self._dataset.append(TransitionBatch(*(np.concatenate([getattr(s, n) for s in self._steps]) for n in names)))
            self._steps = []

    def warn_of_reused_arrays(self) -> None:
        """Warns, once, where last observations of episodes seem to be overwritten by the resets that follow.

        That is so where all of them are the next episode's first, which is improbable by how often that one is observed.
        """
        if not self._ends_at_starts or len(self._starts) < 2:
            return
        observed, starts = np.sort(hash_rows(self._dataset.rows().states)), hash_rows(np.concatenate(self._starts[1:]))
        counts = np.searchsorted(observed, starts, side="right") - np.searchsorted(observed, starts, side="left")
        if np.log(np.maximum(counts, 1) / len(observed)).sum() > np.log(CHANCE):
            return
        self._ends_at_starts = False
        warnings.warn(
            f"All {len(starts)} episodes so far ended with the observation that the next one starts with, so the environment "
            "probably returns an array that its reset overwrites; make its step and reset return copies (return obs.copy()), or "
            "ignore this if its episodes do end where they start.",
            UserWarning,
            stacklevel=3,
        )

    def starts(self) -> States:
        """Distinct start states met so far, int64 [S, F], in the order met."""
        starts = np.concatenate(self._starts) if self._starts else np.zeros((0, len(self._space)), dtype=np.int64)
        return distinct_rows(starts)


def warn_of_forgetting(learned: bool, data: TransitionDataset) -> None:
    """Warns where the next fit would replace what an agent has learned: transitions that it was fitted to are not at hand."""
    if learned and not len(data):
        warnings.warn(
            "This agent has weights, but not the transitions that they were learned from (it was loaded, or given weights), so "
            "learn() will replace what it knows by what the new steps tell. Save agents with include=['transitions'], or call "
            "load_transitions(path) first.",
            UserWarning,
            stacklevel=3,
        )


def distinct_rows(rows: States) -> States:
    """The distinct rows [S, F] of [N, F], in the order of their first appearance."""
    if len(rows) == 0:
        return rows
    _, first = np.unique(rows, axis=0, return_index=True)
    return rows[np.sort(first)]
