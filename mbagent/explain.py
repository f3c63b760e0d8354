"""Explanations of an agent's action: the planner's results for one observation, and the most probable futures."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.systematic_sampling import RARE_VALUE
from mbagent.planning.planner import Planner, PlannerSettings
from mbagent.planning.planners import ValueIterationPlanner
from mbagent.planning.trajectories import PlanTrace, TracingPlanner, likeliest_trajectories
from mbagent.policies import NO_GOAL, PlannerPolicy
from mbagent.spaces import as_batch
from mbagent.types import Floats, States
from mbagent_envs.random_keys import derive

REPEATS = 8
"""Number of decisions with different random numbers from which standard errors are computed."""

SHORT = 24
"""Observations are shown in ``Explanation.table`` if their text is at most this long."""

_OTHER_SEEDS = 0xE59A1


@dataclass(frozen=True)
class Step:
    """One simulated step.

    Attributes:
        action: the action, in the action space's own form.
        observation: the next observation, in the observation space's own form.
        probability: probability of this observation given the previous one and the action, as used by the planner. If the model
            samples successors instead of listing them, this is the observation's share of the samples (with 4 samples, a new
            maze that is sampled once has 25%, even if a thousand mazes are possible).
        reward: reward of this step, under the goal.
        terminated: whether the step ends the episode.
    """

    action: Any
    observation: Any
    probability: float
    reward: float
    terminated: bool


@dataclass(frozen=True)
class Future:
    """One possible trajectory.

    Attributes:
        steps: at least one step.
        probability: product of the steps' probabilities.
    """

    steps: tuple[Step, ...]
    probability: float


@dataclass(frozen=True)
class Explanation:
    """The planner's results for one observation; entry i of each array [A] belongs to action number i.

    Observations are in the observation space's own form, so that a game can draw them::

        from mbagent_envs.drawing import draw_ansi

        why = agent.explain(obs)
        print(why.table())
        for step in why.futures[why.best][0].steps:
            print(step.action, step.reward, draw_ansi(env.unwrapped.game.scene(step.observation)))

    Attributes:
        observation: the explained observation.
        actions: the actions [A], in the action space's own form.
        best: index in ``actions`` of the action that ``predict`` takes.
        values: float64 [A], estimated discounted return of taking each action and then following the planner's best policy (with
            flat Monte Carlo, random play).
        errors: float64 [A], standard errors of the values: the standard deviation (ddof=1) over ``REPEATS`` decisions that
            differ only in the planner's random numbers. These errors measure the randomness of simulations and of sampled
            successors (0 if there is neither), but not the error of the model (see models.model_error).
        chosen: float64 [A], share of these decisions that took the action. Since all actions of one decision are evaluated with
            the same random numbers, this says more about the certainty of the choice than overlapping error bars do.
        visits: float64 [A], number of simulations through each action; all 0 if nothing was simulated, as with
            ValueIterationPolicy or if the whole MDP is solved.
        mdp_states: number of states of the reachable MDP if it was solved completely, else 0.
        futures: for each action, its most probable simulated futures, in decreasing order of probability. After the action, each
            future follows the planner's best policy. With flat Monte Carlo, which has no such policy, futures are one step long.
        rare: for each action, the outcomes in the plan that are less probable than ``RARE_VALUE``, in decreasing order of their
            absolute effect on the action's value (with flat Monte Carlo, which computes no effects, in increasing order of
            probability). Probabilities are posterior means if the model is learned from counts.
        effects: for each outcome in ``rare``, the action's value minus the mean value of the action's other outcomes; 0 with
            flat Monte Carlo.
    """

    observation: Any
    actions: NDArray[Any]
    best: int
    values: Floats
    errors: Floats
    chosen: Floats
    visits: Floats
    mdp_states: int
    futures: tuple[tuple[Future, ...], ...]
    rare: tuple[tuple[Step, ...], ...]
    effects: tuple[tuple[float, ...], ...]

    @property
    def machine_states(self) -> int:
        """Deprecated name of ``mdp_states``."""
        warnings.warn("Explanation.machine_states is now mdp_states.", DeprecationWarning, stacklevel=2)
        return self.mdp_states

    def table(self, n_actions: int = 5) -> str:
        """The best actions and their futures, as text.

        Args:
            n_actions: maximum number of actions shown: first the chosen action, then the others in decreasing order of value.
        """
        rest = [int(a) for a in np.argsort(-self.values, kind="stable") if a != self.best]
        rows = [self.best, *rest][: max(n_actions, 1)]
        names = {a: _text(self.actions[a]) for a in rows}
        width = max(6, *map(len, names.values()))
        lines = [self._headline(), f"{'action':>{width}}       value   std. error  chosen  visits"]
        for a in rows:
            figures = f"{self.values[a]:12.4g} {self.errors[a]:12.2g} {self.chosen[a]:7.0%} {self.visits[a]:7.0f}"
            lines.append(f"{names[a]:>{width}}{figures}{'  <- taken' if a == self.best else ''}")
        for a in rows:
            lines.append(f"likeliest futures of action {names[a]}:")
            lines += [f"  {future.probability:6.1%}  {_as_text(future)}" for future in self.futures[a]]
            for step, effect in zip(self.rare[a], self.effects[a], strict=True):
                lines.append(
                    f"  {step.probability:6.2g}  {_as_text(Future((step,), step.probability))}: rare, {effect:+.3g} in value"
                )
        return "\n".join(lines)

    def _headline(self) -> str:
        if self.mdp_states:
            return f"The reachable MDP of {self.mdp_states:,} states is solved completely; no search was needed."
        return f"{self.visits.sum():.0f} simulations." if self.visits.any() else "Values of a lookahead around the state."


def explain(policy: PlannerPolicy, observation: Any, n_futures: int = 3, n_steps: int = 10) -> Explanation:
    """An explanation of a policy's action for one observation; see ``ModelLearningAgent.explain``."""
    for name, value in (("n_futures", n_futures), ("n_steps", n_steps)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}.")
    with policy.lock.planning():
        return _explanation(policy, observation, n_futures, n_steps)


def _explanation(policy: PlannerPolicy, observation: Any, n_futures: int, n_steps: int) -> Explanation:
    state = _single_state(policy, observation)
    # A time budget or the last decision's tree would make explanations irreproducible.
    settings = replace(policy.settings, time_budget=None, reuse_tree=False)
    planner = _planner(policy, settings, policy.planner)
    found = _trace(planner, state)
    others = _other_values(policy, settings if found.mdp_states else replace(settings, max_states=1), state, planner)
    values = np.concatenate([found.plan.values, *(plan_values for plan_values, _ in others)])
    taken = [int(found.plan.actions[0]), *(action for _, action in others)]
    return Explanation(
        observation=_row(policy.factored.decode(state), 0),
        actions=policy.actions.decode(np.arange(policy.actions.n)),
        best=taken[0],
        values=found.plan.values[0],
        errors=(values - values[0]).std(axis=0, ddof=1),  # exactly 0 if all are equal
        chosen=np.bincount(taken, minlength=policy.actions.n) / len(taken),
        visits=found.plan.visits[0],
        mdp_states=found.mdp_states,
        futures=_futures(policy, found, n_futures, n_steps),
        **_rare(policy, found, n_futures),
    )


def _single_state(policy: PlannerPolicy, observation: Any) -> States:
    """Encodes the observation as factors [1, F]; raises ValueError if the agent cannot plan for it."""
    if not policy.fitted:
        raise ValueError("This agent has learned nothing yet, so there is nothing to explain; call learn() first.")
    if policy.goal is None:
        raise ValueError(NO_GOAL)
    batch, single = as_batch(policy.observation_space, observation)
    if not single:
        raise ValueError("explain() takes one observation, got a batch; give its rows one at a time.")
    return policy.factored.encode(batch)


def _planner(policy: PlannerPolicy, settings: PlannerSettings, like: Planner) -> Planner:
    """A new planner with the lookahead configuration of ``like``; leaves the policy's own planner unchanged."""
    planner = policy.planner_class(settings)
    planner.set_model(policy.transition_model, policy.start_states)
    assert policy.goal is not None  # checked in ``_single_state``
    planner.set_goal(policy.goal)
    if isinstance(planner, ValueIterationPlanner) and isinstance(like, ValueIterationPlanner):
        planner.config = like.config
    return planner


def _trace(planner: Planner, state: States) -> PlanTrace:
    if not isinstance(planner, TracingPlanner):
        raise TypeError(f"explain() needs a planner with trace(root), which {type(planner).__name__} does not have.")
    return planner.trace(state)


def _other_values(policy: PlannerPolicy, settings: PlannerSettings, state: States, like: Planner) -> list[tuple[Floats, int]]:
    """(values [1, A], action taken) of each decision with other random numbers."""
    found = []
    for repeat in range(1, REPEATS):
        seed = int(derive(settings.seed, _OTHER_SEEDS, repeat)[0] >> np.uint64(1))
        plan = _planner(policy, replace(settings, seed=seed), like).plan(state)
        found.append((plan.values, int(plan.actions[0])))
    return found


def _steps(policy: PlannerPolicy, found: PlanTrace, edges: Sequence[int]) -> tuple[Step, ...]:
    """Converts edges of the state graph into steps."""
    if len(edges) == 0:
        return ()
    graph, actions = found.graph, policy.actions.decode(np.arange(policy.actions.n))
    observations = policy.factored.decode(graph.states[graph.next_nodes[edges]])
    return tuple(
        Step(
            actions[graph.actions[edge]],
            _row(observations, i),
            float(graph.probabilities[edge]),
            float(found.rewards[edge]),
            bool(graph.terminated[edge]),
        )
        for i, edge in enumerate(edges)
    )


def _futures(policy: PlannerPolicy, found: PlanTrace, n_futures: int, n_steps: int) -> tuple[tuple[Future, ...], ...]:
    def future(path: list[int]) -> Future:
        steps = _steps(policy, found, path)
        return Future(steps, float(np.prod([step.probability for step in steps])))

    return tuple(tuple(map(future, paths)) for paths in likeliest_trajectories(found, n_futures, n_steps))


def _rare(policy: PlannerPolicy, found: PlanTrace, most: int) -> dict[str, Any]:
    """The fields ``rare`` and ``effects`` of Explanation, with at most ``most`` outcomes for each action."""
    graph, steps, effects = found.graph, [], []
    for first, count in zip(graph.first[found.root], graph.counts[found.root], strict=True):
        edges = np.arange(first, first + count)
        chances, changes = graph.probabilities[edges], np.zeros(count)
        if found.values is not None:
            after = np.where(graph.terminated[edges], 0.0, policy.settings.gamma * found.values[graph.next_nodes[edges]])
            worth = found.rewards[edges] + after
            others = ((chances * worth).sum() - chances * worth) / np.maximum(1.0 - chances, 1e-12)
            changes = chances * (worth - others)
        kept = np.flatnonzero(chances < RARE_VALUE)
        kept = kept[np.lexsort((chances[kept], -np.abs(changes[kept])))][:most]
        steps.append(_steps(policy, found, edges[kept].tolist()))
        effects.append(tuple(changes[kept].tolist()))
    return {"rare": tuple(steps), "effects": tuple(effects)}


def _row(batch: Any, index: int) -> Any:
    """The observation at ``index`` in a batch that has the form of ``batch_space``."""
    if isinstance(batch, Mapping):
        return {key: _row(part, index) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_row(part, index) for part in batch)
    return batch[index]


def _as_text(future: Future) -> str:
    """A future as one line of text: actions, observations (if short), non-zero rewards, and termination."""
    parts = []
    for step in future.steps:
        seen = _text(step.observation)
        reward = f" ({step.reward:+.4g})" if step.reward else ""
        parts.append(f"{_text(step.action)}{f' > {seen}' if len(seen) <= SHORT else ''}{reward}")
    return ", ".join(parts) + (", the end" if future.steps[-1].terminated else "")


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_text(part)}" for key, part in value.items()) + "}"
    if isinstance(value, tuple):
        return "(" + ", ".join(map(_text, value)) + ")"
    return " ".join(str(np.asarray(value).tolist()).split())
