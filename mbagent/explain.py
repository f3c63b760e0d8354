"""Why an agent takes an action: what its planner found for one observation, and the futures it imagines."""

from __future__ import annotations

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
"""Decisions with different random numbers that the standard errors come from."""

SHORT = 24
"""Observations whose text is at most this long stand in ``Explanation.table``."""

_OTHER_SEEDS = 0xE59A1


@dataclass(frozen=True)
class Step:
    """One imagined step.

    Attributes:
        action: the action, in the action space's own form.
        observation: the observation it leads to, in the observation space's own form.
        probability: of this observation after the one before and the action, as imagined: where a model draws successors
            instead of listing them, the share of the planner's draws (of 4, say: one of a thousand new mazes has 25% then).
        reward: of this step, under the goal.
        terminated: whether the episode ends with it.
    """

    action: Any
    observation: Any
    probability: float
    reward: float
    terminated: bool


@dataclass(frozen=True)
class Future:
    """One way things may go.

    Attributes:
        steps: at least one.
        probability: of all of them, the product of theirs.
    """

    steps: tuple[Step, ...]
    probability: float


@dataclass(frozen=True)
class Explanation:
    """What the planner found for one observation; A actions, in the order of their numbers.

    Observations are in the observation space's own form, so that a game can draw them::

        from mbagent_envs.drawing import draw_ansi

        why = agent.explain(obs)
        print(why.table())
        for step in why.futures[why.best][0].steps:
            print(step.action, step.reward, draw_ansi(env.unwrapped.game.scene(step.observation)))

    Attributes:
        observation: what was explained.
        actions: the actions [A], in the action space's own form.
        best: row of the action that ``predict`` takes.
        values: float64 [A], estimated discounted return of each action with the best behaviour found after it (flat Monte
            Carlo: with random play).
        errors: float64 [A], standard errors of the values: the standard deviation (ddof=1) over ``REPEATS`` decisions that
            differ in the planner's random numbers only. They tell how much is due to the luck of simulations and drawn
            successors, 0 where neither plays a part; how wrong the model is, they cannot tell (see models.trust).
        chosen: float64 [A], share of these decisions that took the action. Luck is shared between the actions of a decision,
            so this says more about the choice than errors that overlap.
        visits: float64 [A], simulations through each action; all 0 where none were made: with the ValueIterationPolicy, and
            wherever the whole machine is solved.
        machine_states: number of states of the reachable machine if it was solved as a whole; 0 if it is too large.
        futures: for each action its likeliest imagined futures, the likeliest first. After the action they follow the
            best behaviour found (with flat Monte Carlo, which has none, they are one step long).
        rare: for each action the outcomes less probable than ``RARE_VALUE`` that take part in its value, those first that change
            it most (with flat Monte Carlo, which has no values of them, the least likely first). Probabilities are posterior
            means, of counts where the model is learned from counts.
        effects: for each of these, what it adds to the action's value, compared with an outcome as good as the others are on
            average; 0 with flat Monte Carlo.
    """

    observation: Any
    actions: NDArray[Any]
    best: int
    values: Floats
    errors: Floats
    chosen: Floats
    visits: Floats
    machine_states: int
    futures: tuple[tuple[Future, ...], ...]
    rare: tuple[tuple[Step, ...], ...]
    effects: tuple[tuple[float, ...], ...]

    def table(self, n_actions: int = 5) -> str:
        """The best actions and their futures, as text.

        Args:
            n_actions: rows, at most; the action taken comes first, the others by value.
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
            lines += [f"  {future.probability:6.1%}  {_described(future)}" for future in self.futures[a]]
            for step, effect in zip(self.rare[a], self.effects[a], strict=True):
                lines.append(
                    f"  {step.probability:6.2g}  {_described(Future((step,), step.probability))}: rare, {effect:+.3g} in value"
                )
        return "\n".join(lines)

    def _headline(self) -> str:
        if self.machine_states:
            return f"The reachable machine of {self.machine_states:,} states is solved as a whole; nothing was searched."
        return f"{self.visits.sum():.0f} simulations." if self.visits.any() else "Values of a machine imagined around the state."


def explain(policy: PlannerPolicy, observation: Any, n_futures: int = 3, n_steps: int = 10) -> Explanation:
    """What a policy's planner finds for one observation; see ``ModelLearningAgent.explain``."""
    for name, value in (("n_futures", n_futures), ("n_steps", n_steps)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}.")
    with policy.lock.planning():
        return _explained(policy, observation, n_futures, n_steps)


def _explained(policy: PlannerPolicy, observation: Any, n_futures: int, n_steps: int) -> Explanation:
    state = _single_state(policy, observation)
    # A deadline, or the last decision's tree, would make two explanations of one observation differ.
    settings = replace(policy.settings, time_budget=None, reuse_tree=False)
    planner = _planner(policy, settings, policy.planner)
    found = _trace(planner, state)
    others = _other_values(policy, settings if found.machine_states else replace(settings, max_states=1), state, planner)
    values = np.concatenate([found.plan.values, *(plan_values for plan_values, _ in others)])
    taken = [int(found.plan.actions[0]), *(action for _, action in others)]
    return Explanation(
        observation=_row(policy.factored.decode(state), 0),
        actions=policy.actions.decode(np.arange(policy.actions.n)),
        best=taken[0],
        values=found.plan.values[0],
        errors=(values - values[0]).std(axis=0, ddof=1),  # exactly 0 where all are equal
        chosen=np.bincount(taken, minlength=policy.actions.n) / len(taken),
        visits=found.plan.visits[0],
        machine_states=found.machine_states,
        futures=_futures(policy, found, n_futures, n_steps),
        **_rare(policy, found, n_futures),
    )


def _single_state(policy: PlannerPolicy, observation: Any) -> States:
    """The observation as factors [1, F], if there is something to explain."""
    if not policy.fitted:
        raise ValueError("This agent has learned nothing yet, so there is nothing to explain; call learn() first.")
    if policy.goal is None:
        raise ValueError(NO_GOAL)
    batch, single = as_batch(policy.observation_space, observation)
    if not single:
        raise ValueError("explain() takes one observation, got a batch; give its rows one at a time.")
    return policy.factored.encode(batch)


def _planner(policy: PlannerPolicy, settings: PlannerSettings, like: Planner) -> Planner:
    """A planner of its own, so that the policy's is left as it is; it looks ahead as another one does."""
    planner = policy.planner_class(settings)
    planner.set_model(policy.transition_model, policy.start_states)
    assert policy.goal is not None  # ``_single_state`` has seen to it
    planner.set_goal(policy.goal)
    if isinstance(planner, ValueIterationPlanner) and isinstance(like, ValueIterationPlanner):
        planner.share_config(like)
    return planner


def _trace(planner: Planner, state: States) -> PlanTrace:
    if not isinstance(planner, TracingPlanner):
        raise TypeError(f"explain() needs a planner with foresee(root), which {type(planner).__name__} has not.")
    return planner.trace(state)


def _other_values(policy: PlannerPolicy, settings: PlannerSettings, state: States, like: Planner) -> list[tuple[Floats, int]]:
    """(values [1, A], action taken) of decisions with other random numbers."""
    found = []
    for repeat in range(1, REPEATS):
        seed = int(derive(settings.seed, _OTHER_SEEDS, repeat)[0] >> np.uint64(1))
        plan = _planner(policy, replace(settings, seed=seed), like).plan(state)
        found.append((plan.values, int(plan.actions[0])))
    return found


def _steps(policy: PlannerPolicy, found: PlanTrace, edges: Sequence[int]) -> tuple[Step, ...]:
    """What some edges of the graph stand for."""
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
    """``rare`` and ``effects`` of Explanation, ``most`` of each action."""
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
    """One observation of a batch laid out as ``batch_space`` does."""
    if isinstance(batch, Mapping):
        return {key: _row(part, index) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_row(part, index) for part in batch)
    return batch[index]


def _described(future: Future) -> str:
    """A future as a line: actions, short observations, rewards other than 0, the end."""
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
