"""Compares two checkouts byte for byte.

python scripts/compare_checkouts.py OLD NEW              # three seeds; about ten minutes each on one core
python scripts/compare_checkouts.py OLD NEW --seeds 1 --cases "FrozenLake, auto"

Experience, weights, samples, probabilities, successors and plans are compared. Both checkouts run with this Python and its
libraries, one after the other. A refactoring that changes no number prints "equal" for each case. Only the contents of arrays
are compared, not their names, so that arrays may be renamed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

STEPS = 1500
"""Environment steps for learning."""

N_ROWS = 40
"""Number of observed states for which predictions are compared."""

CASES: Mapping[str, tuple[str, str, str]] = {
    "GeyserRunner, auto": ("mbagent/GeyserRunner-v0", "auto", "MctsPolicy"),
    "GeyserRunner, value iteration": ("mbagent/GeyserRunner-v0", "auto", "ValueIterationPolicy"),
    "GeyserRunner, flat Monte Carlo": ("mbagent/GeyserRunner-v0", "auto", "FlatMonteCarloPolicy"),
    "GeyserRunner, tabular": ("mbagent/GeyserRunner-v0", "tabular", "MctsPolicy"),
    "GeyserRunner, networks": ("mbagent/GeyserRunner-v0", "networks", "MctsPolicy"),
    "GeyserRunner, paper": ("mbagent/GeyserRunner-v0", "paper", "FlatMonteCarloPolicy"),
    "Maneuverer, auto": ("mbagent/Maneuverer-v0", "auto", "MctsPolicy"),
    "FlierCatcher, auto": ("mbagent/FlierCatcher-v0", "auto", "MctsPolicy"),
    "FlierCatcher, networks": ("mbagent/FlierCatcher-v0", "networks", "MctsPolicy"),
    "FrozenLake, auto": ("FrozenLake-v1", "auto", "MctsPolicy"),
    "Taxi, auto": ("Taxi-v3", "auto", "ValueIterationPolicy"),
    "Store, auto": ("store", "auto", "MctsPolicy"),
}
"""Name: environment, model, policy."""


def digest(*arrays: Any) -> str:
    """Digest of the contents, types and shapes of arrays."""
    found = hashlib.sha256()
    for array in map(np.ascontiguousarray, arrays):
        found.update(f"{array.dtype} {array.shape} ".encode() + array.tobytes())
    return found.hexdigest()[:16]


def make(name: str) -> Any:
    """Creates an environment; "store" has two stocks with random demand and no ``reward_fn``."""
    import gymnasium as gym  # noqa: PLC0415 (imported in the checkout's process)

    if name != "store":
        return gym.make("Taxi-v4" if name.startswith("Taxi") and "Taxi-v4" in gym.registry else name)

    class Store(gym.Env[Any, Any]):
        observation_space, action_space = gym.spaces.MultiDiscrete([12, 8]), gym.spaces.MultiDiscrete([3, 3])

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
            super().reset(seed=seed)
            self.stock = np.array([5, 3])
            return self.stock.copy(), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            demand = self.np_random.integers(0, 3, size=2)
            held = np.minimum(self.stock + action, [11, 7])
            sold = np.minimum(held, demand)
            self.stock = held - sold
            return self.stock.copy(), float(2 * sold.sum() - 0.1 * self.stock.sum()), False, False, {}

    return gym.wrappers.TimeLimit(Store(), 50)


def probe(case: str, seed: int) -> dict[str, str]:
    """Digests of all results of a case."""
    from mbagent import LearnedEnv, ModelLearningAgent  # noqa: PLC0415 (of the checkout under test)

    env_id, model, policy = CASES[case]
    env = make(env_id)
    kwargs: dict[str, Any] = {"num_simulations": 60} if policy != "ValueIterationPolicy" else {}
    agent = ModelLearningAgent(policy, env, model=model, seed=seed, **kwargs).learn(STEPS, log_interval=None)
    rows = agent.transitions.rows()
    some = np.linspace(0, len(rows) - 1, N_ROWS).astype(np.int64)
    states, actions = rows.states[some], rows.actions[some]
    found = {"experience": digest(rows.states, rows.actions, rows.next_states, rows.terminated)}
    found |= model_digests(agent.model, states, actions, rows.next_states[some], rows.terminated[some], seed)
    found["plans"] = plans(agent, states)
    learned = LearnedEnv(agent)
    learned.reset(seed=seed)
    learned.action_space.seed(seed)
    steps = [learned.step(learned.action_space.sample())[:2] for _ in range(10)]
    found["LearnedEnv"] = digest(*[np.asarray(obs) for obs, _ in steps], np.array([reward for _, reward in steps]))
    if model in ("networks", "paper"):
        agent.prune(0.8)
        found["pruned plans"] = plans(agent, states[:4])
        digests = model_digests(agent.model, states, actions, rows.next_states[some], rows.terminated[some], seed)
        found |= {f"pruned {name}": value for name, value in digests.items()}
    return found


def model_digests(model: Any, states: Any, actions: Any, following: Any, ends: Any, seed: int) -> dict[str, str]:
    """Digests of a model's weights and of its predictions for some transitions."""
    found = {"weights": digest(*sorted((np.asarray(a) for a in model.state_dict().values()), key=digest))}
    found["marginals"] = digest(model.marginals(states, actions))
    found["sample"] = digest(*model.sample(states, actions, np.random.default_rng(seed)))
    try:
        found["log_prob"] = digest(model.log_prob(states, actions, following, ends))
    except NotImplementedError:
        found["log_prob"] = "none"
    listed = model.successors(states, actions, 16, seed=seed)
    found["successors"] = digest(listed.offsets, listed.states, listed.terminated, listed.probabilities)
    return found


def plans(agent: Any, states: Any) -> str:
    """Digest of the decisions in some states, with their explanations."""
    space = agent.policy.factored
    observations = space.decode(states[:12])
    chosen, _ = agent.predict(observations, deterministic=True)
    first = space.decode(states[:1])
    why = agent.explain(first[0] if isinstance(first, np.ndarray) else first)
    return digest(chosen, why.values, why.errors, why.visits, why.chosen)


def compute(args: argparse.Namespace) -> dict[str, dict[str, str]]:
    """Digests of all cases and seeds, computed in this process."""
    import torch  # noqa: PLC0415

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    found = {}
    for case in args.cases:
        for seed in range(args.seeds):
            found[f"{case}, seed {seed}"] = probe(case, seed)
            sys.stderr.write(f"  {case}, seed {seed}\n")
    return found


def run(checkout: Path, args: argparse.Namespace) -> dict[str, dict[str, str]]:
    """The same with the code of a checkout, in a separate process."""
    folders = [str(checkout.resolve()), str(checkout.resolve() / "envs")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(folders), "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "found.json"
        command = [sys.executable, str(Path(__file__).resolve()), "--write", str(target), "--seeds", str(args.seeds)]
        subprocess.run([*command, "--cases", *args.cases], env=environment, cwd=folder, check=True)
        result: dict[str, dict[str, str]] = json.loads(target.read_text(encoding="utf-8"))
        return result


def main() -> int:
    """Runs the command line; returns 1 if anything differs."""
    parser = argparse.ArgumentParser(description="Compares two checkouts byte for byte.")
    parser.add_argument("checkouts", nargs="*", type=Path, help="two folders")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.write is not None:
        args.write.write_text(json.dumps(compute(args)), encoding="utf-8")
        return 0
    if len(args.checkouts) != 2:
        parser.error("name two checkouts")
    old, new = (run(checkout, args) for checkout in args.checkouts)
    differing = 0
    for case, was in old.items():
        wrong = [name for name, value in was.items() if new[case].get(name) != value]
        differing += bool(wrong)
        sys.stdout.write(f"{case}: " + (f"DIFFERS in {', '.join(wrong)}\n" if wrong else f"equal ({len(was)} digests)\n"))
    sys.stdout.write(f"{differing} of {len(old)} differ.\n" if differing else f"All {len(old)} are equal.\n")
    return int(differing > 0)


if __name__ == "__main__":
    sys.exit(main())
