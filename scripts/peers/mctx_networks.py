"""Searches with mctx, a learned predictor and a causal conditioner. Run as: mctx_networks.py networks.npz.

The networks are sampled in JAX as in ``mbagent.models.neural.sampling.sample_causal``: variables of which the predictor is
certain are sampled from it, all others from the conditioner, given those sampled before.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from peers.common import stay_on_one_core

stay_on_one_core()

import jax
import jax.numpy as jnp
import mctx
import numpy as np

Params = dict[str, Any]

MAX_DEPTH = 15
"""Maximum number of steps from the root."""


def predict(params: Params, states: Any, actions: Any) -> tuple[Any, Any]:
    """Logits [B, O] of the bits, and the encoded inputs [B, n_inputs]."""
    hot = jax.nn.one_hot(actions, params["dense_stay"].shape[0])
    columns = jnp.concatenate([states, hot], axis=1)
    hidden = jax.nn.silu(columns @ params["dense_first"] + params["dense_bias"][0])
    logits = hidden @ params["dense_last"] + params["dense_last_bias"]
    stay = (hot @ params["dense_stay"]) * (2.0 * states - 1.0)
    return logits.at[:, : states.shape[1]].add(stay), columns


def sample(params: Params, key: Any, states: Any, actions: Any) -> Any:
    """Next bits [B, O], ``terminated`` last."""
    logits, columns = predict(params, states, actions)
    noise = jax.random.uniform(key, logits.shape)
    p = jax.nn.sigmoid(logits)
    sure = jnp.maximum(p, 1.0 - p) >= params["certain"]
    drawn = (noise < p).astype(jnp.float32)
    known = jnp.einsum("bi,gih->gbh", columns, params["group_inputs"]) + params["group_bias"][:, None, :]

    def condition(outcome: Any, group: Any) -> tuple[Any, None]:
        # A conditioner masked to y_<i has weight 0 for bits not sampled yet, so all of ``outcome`` can be its input.
        hidden = jax.nn.silu(group["known"] + outcome @ group["others"])
        i = group["member"]
        logit = logits[:, i] + hidden @ group["readout"][:, 1] + group["offset"][1]
        bit = (noise[:, i] < jax.nn.sigmoid(logit)).astype(jnp.float32)
        return outcome.at[:, i].set(jnp.where(sure[:, i], outcome[:, i], bit)), None

    groups = {
        "known": known,
        "others": params["group_others"],
        "readout": params["group_readout"],
        "offset": params["group_offset"],
        "member": params["members"],
    }
    outcome, _ = jax.lax.scan(condition, drawn, groups)
    return outcome


def recurrent(params: Params, key: Any, actions: Any, states: Any) -> tuple[Any, Any]:
    """The recurrent_fn: samples the networks; leaf values are 0."""
    outcome = sample(params, key, states, actions)
    following, ended = outcome[:, :-1], outcome[:, -1]
    reward = following @ params["linear"] + jnp.einsum("bi,ij,bj->b", following, params["pairs"], following)
    flat = jnp.zeros((len(states), params["dense_stay"].shape[0]))
    discount = params["gamma"] * (1.0 - ended)
    return mctx.RecurrentFnOutput(reward=reward, discount=discount, prior_logits=flat, value=0.0 * reward), following


@partial(jax.jit, static_argnames="simulations")
def search(params: Params, key: Any, states: Any, simulations: int) -> Any:
    """Actions [B]."""
    flat = jnp.zeros((len(states), params["dense_stay"].shape[0]))
    root = mctx.RootFnOutput(prior_logits=flat, value=jnp.zeros(len(states)), embedding=states)
    found = mctx.gumbel_muzero_policy(params, key, root, recurrent, simulations, max_depth=MAX_DEPTH, gumbel_scale=0.0)
    return found.action


def main(path: Path) -> None:
    """Times the search, and lets it choose actions with each budget; prints one JSON text."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    speeds, repetitions, roots = arrays.pop("speeds"), int(arrays.pop("repetitions")), arrays.pop("roots").astype(np.float32)
    starts, budgets, seeds = arrays.pop("starts").astype(np.float32), arrays.pop("budgets"), arrays.pop("seeds")
    goals = {name: arrays.pop(f"{name}_goals") for name in ("linear", "pairs")}
    params = {name: jnp.asarray(x, dtype=jnp.int32 if name == "members" else jnp.float32) for name, x in arrays.items()}
    results = []
    for n_roots, simulations in speeds.tolist():
        some = jnp.asarray(np.resize(roots, (n_roots, roots.shape[1])))
        search(params, jax.random.PRNGKey(0), some, simulations).block_until_ready()
        seconds = []
        for repetition in range(repetitions):
            began = time.process_time()
            search(params, jax.random.PRNGKey(1 + repetition), some, simulations).block_until_ready()
            seconds.append(time.process_time() - began)
        median = float(np.median(seconds))
        rate = n_roots * simulations / median
        results.append(
            {
                "roots": n_roots,
                "simulations": simulations,
                "seconds": median,
                "simulations_per_second": rate,
                "samples_per_second": rate,
            }
        )
    choices: dict[int, list[Any]] = {}
    for budget in budgets.tolist():
        for linear, pairs in zip(goals["linear"], goals["pairs"], strict=True):
            wanted = {**params, "linear": jnp.asarray(linear, jnp.float32), "pairs": jnp.asarray(pairs, jnp.float32)}
            some = [search(wanted, jax.random.PRNGKey(seed), jnp.asarray(starts), budget) for seed in seeds]
            choices.setdefault(budget, []).append([np.asarray(actions).tolist() for actions in some])
    many = jnp.tile(jnp.asarray(roots[:1]), (20_000, 1))
    drawn = jax.jit(sample)(params, jax.random.PRNGKey(7), many, jnp.zeros(len(many), dtype=jnp.int32))
    mean = np.asarray(drawn[:, :-1].mean(axis=0)).tolist()
    json.dump({"speeds": results, "choices": choices, "mean_next_state": mean}, sys.stdout)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
