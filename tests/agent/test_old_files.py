"""Files that the version before the renaming of arrays and modules saved still load, and decide as they did."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from mbagent import ModelLearningAgent

DATA = Path(__file__).parents[1] / "data"
DECISIONS = json.loads((DATA / "format-1.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", sorted(DECISIONS))
def test_a_file_of_the_version_before_decides_as_it_did(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no environment, so that the learned reward is the goal
        agent = ModelLearningAgent.load(DATA / f"format-1-{name}.zip")
    observations = np.array(DECISIONS[name]["observations"], dtype=agent.observation_space.dtype)
    assert agent.predict(observations, deterministic=True)[0].tolist() == DECISIONS[name]["actions"]
