"""Searches in a tabular MDP with mctx's policies. Run with a Python that has mctx: mctx_search.py world.npz.

Settings are those for evaluation, without exploration: no Gumbel noise, no Dirichlet noise, temperature 0. Priors are uniform.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

from peers.common import Array, Search, read_task, run, stay_on_one_core

stay_on_one_core()

import jax
import jax.numpy as jnp
import mctx
import numpy as np

Params = dict[str, Any]

MAX_DEPTH = 15
"""Maximum number of steps from the root: later ones have weight below half, and unbounded trees are up to four times slower."""


def arrive(params: Params, states: Any) -> tuple[Any, Any, Any]:
    """Reward, discount and leaf value [B] on arrival in states."""
    discount = jnp.where(params["ends"][states], 0.0, params["gamma"])
    return params["rewards"][states], discount, params["leaf_values"][states]


def sample_step(params: Params, key: Any, actions: Any, states: Any) -> tuple[Any, Any]:
    """The recurrent_fn: samples next states from the table."""
    log_p = jnp.log(params["probabilities"][states, actions])
    chosen = jax.random.categorical(key, log_p, axis=-1)
    following = params["successors"][states, actions, chosen]
    reward, discount, value = arrive(params, following)
    flat = jnp.zeros((len(states), params["successors"].shape[1]))
    return mctx.RecurrentFnOutput(reward=reward, discount=discount, prior_logits=flat, value=value), following


def decide(params: Params, key: Any, actions: Any, states: Any) -> tuple[Any, Any]:
    """The decision_recurrent_fn: exact probabilities of the outcomes, and their expected reward plus discounted leaf value."""
    del key
    probabilities = params["probabilities"][states, actions]
    following = params["successors"][states, actions]
    reward, discount, value = arrive(params, following)
    worth = (probabilities * (reward + discount * value)).sum(axis=-1)
    output = mctx.DecisionRecurrentFnOutput(chance_logits=jnp.log(probabilities), afterstate_value=worth)
    return output, following


def take_chance(params: Params, key: Any, outcomes: Any, afterstates: Any) -> tuple[Any, Any]:
    """The chance_recurrent_fn: the state of a given outcome number."""
    del key
    n = afterstates.shape[1]
    following = jnp.take_along_axis(afterstates, jnp.clip(outcomes, 0, n - 1)[:, None], axis=1)[:, 0]
    reward, discount, value = arrive(params, following)
    flat = jnp.zeros((len(outcomes), params["successors"].shape[1]))
    output = mctx.ChanceRecurrentFnOutput(action_logits=flat, value=value, reward=reward, discount=discount)
    return output, following


def root_of(params: Params, states: Any) -> Any:
    """The roots: uniform priors and leaf values."""
    flat = jnp.zeros((len(states), params["successors"].shape[1]))
    return mctx.RootFnOutput(prior_logits=flat, value=params["leaf_values"][states], embedding=states)


@partial(jax.jit, static_argnames="simulations")
def gumbel(params: Params, key: Any, states: Any, simulations: int) -> tuple[Any, Any]:
    """Actions [B], and the number of sampled next states."""
    found = mctx.gumbel_muzero_policy(
        params, key, root_of(params, states), sample_step, simulations, max_depth=MAX_DEPTH, gumbel_scale=0.0
    )
    return found.action, jnp.asarray(len(states) * simulations)


@partial(jax.jit, static_argnames="simulations")
def stochastic(params: Params, key: Any, states: Any, simulations: int) -> tuple[Any, Any]:
    """Actions [B], and the number of expanded next states: a simulation that ends at a chance node adds none."""
    found = mctx.stochastic_muzero_policy(
        params,
        key,
        root_of(params, states),
        decide,
        take_chance,
        simulations,
        max_depth=2 * MAX_DEPTH,  # a step spans two levels of the tree
        dirichlet_fraction=0.0,
        temperature=0.0,
    )
    tree = found.search_tree
    reached = tree.embeddings.is_decision_node & (tree.node_visits > 0)
    return found.action, reached.sum() - len(states)


def main(path: Path) -> None:
    """Runs both policies."""
    task = read_task(path)
    params = {
        name: jnp.asarray(array, dtype=jnp.int32 if name == "successors" else bool if name == "ends" else jnp.float32)
        for name, array in task.arrays.items()
    }

    def search_with(policy: Any) -> Search:
        def search(roots: Array, simulations: int, seed: int) -> tuple[Array, int]:
            actions, samples = policy(params, jax.random.PRNGKey(seed), jnp.asarray(roots, dtype=jnp.int32), simulations)
            return np.asarray(actions), int(samples)

        return search

    run(task, {"mctx, Gumbel MuZero": search_with(gumbel), "mctx, Stochastic MuZero": search_with(stochastic)})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
