import importlib
import subprocess
import sys

import gymnasium as gym
import pytest

import mbagent_envs


@pytest.mark.parametrize("env_id", mbagent_envs.ENV_IDS)
def test_registering_again_changes_nothing_without_a_warning(env_id: str) -> None:
    before = gym.spec(env_id)
    mbagent_envs.register_envs()
    importlib.reload(mbagent_envs)
    assert gym.spec(env_id) is before
    assert before.vector_entry_point == "mbagent_envs.vector_env:GameVectorEnv"


def test_ids_with_the_module_need_no_import_and_drawing_stays_optional() -> None:
    code = (
        "import sys, gymnasium as gym\n"
        "env = gym.make('mbagent_envs:mbagent/Maneuverer-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0); env.render()\n"
        "assert not {'pygame', 'torch', 'stable_baselines3', 'matplotlib', 'mbagent'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)
