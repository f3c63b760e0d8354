"""Time of the first decision in a new process without imports, with everything compiled by an earlier process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from harness import Row
from mbagent.agent import ModelLearningAgent
from worlds.games import find_case

SCRIPTS = Path(__file__).parents[2]
"""Folder of the studies' modules."""

GAMES = ("geyser_deterministic", "flier_catcher", "maneuverer")

_PROCESS = """
import json, sys, time
import numpy as np
import mbagent_envs
from mbagent import ModelLearningAgent
from worlds.games import find_case
env = find_case(sys.argv[3]).make_env() if len(sys.argv) > 3 else None
began = time.process_time()
agent = ModelLearningAgent.load(sys.argv[1], env=env)
loaded = time.process_time()
obs = np.load(sys.argv[2])
agent.predict(obs)
first = time.process_time()
agent.predict(obs)
print(json.dumps([loaded - began, first - loaded, time.process_time() - first]))
"""


def first_decisions(key: str, seed: int, steps: int = 5000) -> list[Row]:
    """Processor time in seconds of loading, the first and the second decision of a learned agent in a new process.

    The first decision includes the work done once per goal: solving the MDP, or fitting a value function. Rows: with the game's
    own reward, and with the learned reward, for which the agent is loaded without an environment.

    Raises:
        RuntimeError: a process failed.
    """
    env = find_case(key).make_env()
    agent = ModelLearningAgent("MctsPolicy", env, seed=seed).learn(steps, log_interval=None)
    agent.goals.fit_learned()
    rows = []
    with TemporaryDirectory() as folder:
        saved, observation = Path(folder) / "agent.zip", Path(folder) / "obs.npy"
        agent.save(saved)
        np.save(observation, env.reset(seed=seed)[0], allow_pickle=False)
        for reward, more in (("own", [key]), ("learned", [])):
            seconds = _timed([sys.executable, "-c", _PROCESS, str(saved), str(observation), *more])
            columns = ("loading, s", "first decision, s", "second decision, s")
            rows.append({"game": key, "reward": reward, **dict(zip(columns, seconds, strict=True))})
    return rows


def _timed(command: list[str]) -> list[float]:
    """Output of the second run of a process; the first run compiles whatever is not compiled yet."""
    path = os.pathsep.join([str(SCRIPTS), *filter(None, [os.environ.get("PYTHONPATH")])])
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path})
        if done.returncode:
            raise RuntimeError(f"A new process could not decide: {done.stderr.strip().splitlines()[-1]}")
    seconds: list[float] = json.loads(done.stdout.strip().splitlines()[-1])
    return seconds
