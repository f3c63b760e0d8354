"""Planner policies: SB3 policies that choose actions by planning with the model."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from mbagent.locks import PlanningLock
from mbagent.models.protocol import TransitionModel
from mbagent.models.reward import LearnedReward
from mbagent.planning.flat_monte_carlo import FlatMonteCarlo, direct_model
from mbagent.planning.planner import Plan, Planner, PlannerSettings
from mbagent.planning.planners import MctsPlanner, ValueIterationPlanner
from mbagent.spaces import ActionEnumeration, FactoredSpace, as_batch
from mbagent.types import Reward, States
from mbagent_envs.random_keys import derive

NO_GOAL = (
    "This agent was saved with a custom reward function, and files contain no code: give it again with "
    "load(path, reward=fn) or agent.set_reward(fn)."
)


class PlannerPolicy(BasePolicy):
    """An SB3 policy that chooses actions by planning.

    The policy's parameters are those of the transition model and of the learned reward. ``state_dict`` and ``load_state_dict``
    handle both; ``load_state_dict`` also clears all planning caches.

    Several threads may call the policy's methods: each call waits until the previous call has ended (see PlanningLock), so the
    results are the same as if a single thread made all calls. Hold ``lock`` around a series of calls that must not be
    interleaved with others.

    Args:
        observation_space: a discrete space (see FactoredSpace).
        action_space: a discrete space (see ActionEnumeration).
        lr_schedule: unused; SB3 passes it.
        model: the transition model.
        reward_model: the learned reward.
        settings: see PlannerSettings.
        factored: the factors that the models use; None for the factors of the declared observation space.

    Attributes:
        lock: held while planning, and while reading or changing data that plans depend on.

    Raises:
        ValueError: the settings contain forecasts="direct", and the planner or the model does not support it; or they contain a
            time budget or tree reuse, and the planner does not support it.
    """

    planner_class: ClassVar[type[Planner]] = MctsPlanner

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Any = None,
        *,
        model: TransitionModel,
        reward_model: LearnedReward,
        settings: PlannerSettings,
        factored: FactoredSpace | None = None,
    ) -> None:
        """See the class."""
        super().__init__(observation_space, action_space)
        del lr_schedule
        self.lock = PlanningLock()
        self.factored = factored if factored is not None else FactoredSpace(observation_space)
        self.actions = ActionEnumeration(action_space)
        self.transition_model, self.reward_model, self.settings = model, reward_model, settings
        if settings.forecasts == "direct":
            if self.planner_class is not FlatMonteCarlo:
                raise ValueError("forecasts='direct' is for the FlatMonteCarloPolicy; other planners plan step by step.")
            direct_model(model)
        if settings.time_budget is not None and self.planner_class is ValueIterationPlanner:
            raise ValueError(
                "time_budget is for policies that simulate; the ValueIterationPolicy is limited by lookahead_states."
            )
        if settings.reuse_tree and not issubclass(self.planner_class, MctsPlanner):
            raise ValueError("reuse_tree is for the MctsPolicy; other planners keep no tree.")
        self.planner: Planner = self.planner_class(settings)
        self.start_states: States = np.zeros((0, len(self.factored)), dtype=np.int64)
        self.goal: Reward | None = None
        self.fitted = False
        self._warned = False
        self._random = np.random.default_rng(int(derive(settings.seed, 0xAC71)[0]))

    def refresh(self, goal: Reward | None = None) -> None:
        """Clears all caches after a change of weights or start states; sets a new goal if one is given."""
        with self.lock:
            self.planner.set_model(self.transition_model, self.start_states)
            self.set_goal(goal if goal is not None else self.goal)

    def parts(self) -> tuple[FactoredSpace, TransitionModel, LearnedReward, States, bool]:
        """The arguments with which ``recode`` restores the current factors, models and start states."""
        return self.factored, self.transition_model, self.reward_model, self.start_states, self.fitted

    def recode(
        self, factored: FactoredSpace, model: TransitionModel, reward_model: LearnedReward, start_states: States, fitted: bool
    ) -> None:
        """Replaces factors, models, start states and ``fitted``; removes the goal."""
        with self.lock:
            self.factored, self.transition_model, self.reward_model = factored, model, reward_model
            self.start_states, self.fitted, self.goal = start_states, fitted, None
            self.refresh()

    def set_goal(self, goal: Reward | None) -> None:
        """Sets the goal; if it is None, ``plan`` raises ValueError."""
        with self.lock:
            self.goal = goal
            if goal is not None:
                self.planner.set_goal(goal)

    def plan(self, states: States) -> Plan:
        """Plans from factored states int64 [B, F].

        Raises:
            ValueError: no goal is known.
            RuntimeError: the reward function called this method during planning.
        """
        with self.lock.planning():
            if self.goal is None:
                raise ValueError(NO_GOAL)
            return self.planner.plan(states)

    def predict(
        self,
        observation: Any,
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Any, tuple[NDArray[Any], ...] | None]:
        """The planner's best action for one observation or a batch; may be called by several threads.

        Args:
            observation: one observation of the space, or a batch of them.
            state: returned unchanged (the policy has no memory).
            episode_start: bool [B]; if any entry is true, the search tree kept by ``reuse_tree`` is cleared.
            deterministic: ignored: the best action is returned in both cases.

        Returns:
            (action or batch of actions in the action space's own form, ``state``).

        Raises:
            ValueError: an observation is outside the space, or no goal is known (see ``NO_GOAL``).
            RuntimeError: the reward function raised an error, which is the ``__cause__`` of this one.
        """
        batch, single = as_batch(self.observation_space, observation)
        with self.lock:
            states = self.factored.encode(batch)
            if self.settings.reuse_tree and isinstance(self.planner, MctsPlanner) and np.any(episode_start):
                self.planner.forget()
            if self.fitted:
                indices = self.plan(states).actions
            else:
                self._warn_unfitted()
                indices = self._random.integers(self.actions.n, size=len(states))
        actions = self.actions.decode(indices)
        return (actions[0] if single else actions), state

    def _warn_unfitted(self) -> None:
        if not self._warned:
            warnings.warn("This agent has learned nothing yet: its actions are random until learn() ends.", stacklevel=4)
            self._warned = True

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Not used: see ``predict``."""
        raise NotImplementedError("A planner policy has no forward pass; call predict().")

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        actions, _ = self.predict(observation, deterministic=deterministic)
        return torch.as_tensor(actions)

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, torch.Tensor]:  # type: ignore[override]
        """Weights of the transition model ("model.…") and learned reward ("reward.…"); values of open factors ("space.…")."""
        return {name: torch.from_numpy(np.array(value)) for name, value in self.arrays().items()}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The contents of ``state_dict`` as numpy arrays."""
        with self.lock:
            parts = {"model": self.transition_model.state_dict(), "reward": self.reward_model.state_dict()}
            arrays = {f"{part}.{name}": value for part, state in parts.items() for name, value in state.items()}
            return arrays | self.factored.value_arrays()

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> None:
        """Loads weights and clears all caches.

        Raises:
            ValueError: the weights do not fit; the policy is unchanged.
        """
        del assign
        with self.lock:
            self._load({name: np.asarray(value) for name, value in state_dict.items()}, strict)

    def _load(self, arrays: dict[str, NDArray[Any]], strict: bool) -> None:
        if not strict:
            arrays = {**self.arrays(), **arrays}
        own = self.factored.value_arrays()
        if any(name in own and not np.array_equal(value, own[name]) for name, value in arrays.items()):
            raise ValueError("These weights are of an agent that observed other values; use agent.set_parameters.")
        arrays = {name: value for name, value in arrays.items() if name not in own}
        unknown = [name for name in arrays if name.partition(".")[0] not in ("model", "reward")]
        if unknown:
            raise ValueError(f"There is no parameter called {unknown[0]!r}; take names from get_parameters()['policy'].")
        for name, value in arrays.items():
            if value.dtype.kind == "f" and not np.isfinite(value).all():
                raise ValueError(f"The parameter {name!r} holds NaN or infinity; take weights from an intact agent.")
        before, reward = self.transition_model.state_dict(), _part(arrays, "reward.")
        self.transition_model.load_state_dict(_part(arrays, "model."))
        try:
            if reward:
                self.reward_model.load_state_dict(reward)
        except (ValueError, RuntimeError, KeyError) as error:
            self.transition_model.load_state_dict(before)
            reason = " ".join(str(error).split())
            raise ValueError(
                f"These weights do not fit this agent's learned reward, so none was taken over: {reason}."
            ) from error
        self.fitted = True
        self.refresh()

    def save(self, path: Any) -> None:
        """Not supported: a policy without its agent's settings could not be loaded again."""
        raise NotImplementedError("A planner policy is saved with its agent: agent.save(path), ModelLearningAgent.load(path).")

    @classmethod
    def load(cls, path: Any, device: Any = "auto") -> Any:
        """Not supported, see ``save``."""
        raise NotImplementedError("A planner policy is loaded with its agent: ModelLearningAgent.load(path).policy.")


class MctsPolicy(PlannerPolicy):
    """Monte Carlo tree search on the learned model (the default)."""

    planner_class = MctsPlanner


class FlatMonteCarloPolicy(PlannerPolicy):
    """The paper's basic search (section 4.1): each action is evaluated by subsequent random play."""

    planner_class = FlatMonteCarlo


class ValueIterationPolicy(PlannerPolicy):
    """Greedy with respect to the optimal values of the MDP generated from the model (paper, section 2)."""

    planner_class = ValueIterationPlanner


def _part(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
