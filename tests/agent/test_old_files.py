"""Files saved by the version before the renaming of arrays and modules can be loaded, with the same decisions."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from mbagent import ModelLearningAgent

DATA = Path(__file__).parents[1] / "data"
DECISIONS = json.loads((DATA / "format-1.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", sorted(DECISIONS))
def test_a_file_of_the_previous_version_gives_the_same_decisions(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the missing environment, without which the learned reward is the goal
        agent = ModelLearningAgent.load(DATA / f"format-1-{name}.zip")
    observations = np.array(DECISIONS[name]["observations"], dtype=agent.observation_space.dtype)
    assert agent.predict(observations, deterministic=True)[0].tolist() == DECISIONS[name]["actions"]
