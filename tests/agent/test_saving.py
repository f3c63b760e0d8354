import io
import json
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO

from mbagent import ModelLearningAgent, checkpoint
from mbagent.models.registry import build_graphs, register_model
from tests.worlds import Corridor, TableWorld, random_table

GEYSER = "mbagent/GeyserRunner-v0"


def corner(obs: Any, action: Any, next_obs: Any) -> Any:
    """Reward for the first column."""
    return next_obs[:, 0]


@pytest.fixture(scope="module")
def agent() -> ModelLearningAgent:
    return ModelLearningAgent("MctsPolicy", gym.make(GEYSER, hit_cost=5.0), seed=0).learn(3000, log_interval=None)


def observations() -> np.ndarray:
    env = gym.make(GEYSER)
    env.action_space.seed(0)
    rows = [env.reset(seed=0)[0]]
    rows += [env.step(env.action_space.sample())[0] for _ in range(30)]
    return np.stack(rows)


@pytest.mark.parametrize("with_env", [True, False])
def test_predictions_are_the_same_after_loading(agent: ModelLearningAgent, tmp_path: Path, with_env: bool) -> None:
    before, _ = agent.predict(observations(), deterministic=True)
    agent.save(tmp_path / "agent")
    if with_env:
        loaded = ModelLearningAgent.load(tmp_path / "agent", env=gym.make(GEYSER, hit_cost=5.0))
    else:
        with pytest.warns(UserWarning, match="no environment"):
            loaded = ModelLearningAgent.load(tmp_path / "agent")
    after, _ = loaded.predict(observations(), deterministic=True)
    alone = [int(loaded.predict(obs, deterministic=True)[0]) for obs in observations()]
    assert before.tolist() == after.tolist() == alone


def test_a_loaded_agent_continues_to_learn(agent: ModelLearningAgent, tmp_path: Path) -> None:
    agent.save(tmp_path / "agent", include=["transitions"])
    loaded = ModelLearningAgent.load(tmp_path / "agent", env=gym.make(GEYSER, hit_cost=5.0), num_simulations=8)
    assert loaded.num_simulations == 8
    loaded.learn(200, reset_num_timesteps=False, log_interval=None)
    assert loaded.num_timesteps == 3200
    assert len(loaded.transitions) == 3200


def test_transitions_are_included_by_name_or_in_a_list(agent: ModelLearningAgent, tmp_path: Path) -> None:
    agent.save(tmp_path / "agent", include="transitions")
    assert len(ModelLearningAgent.load(tmp_path / "agent", env=gym.make(GEYSER, hit_cost=5.0)).transitions) == 3000
    for wrong in ("replay", ["transitions", "replay"]):
        with pytest.raises(ValueError, match="takes 'transitions' only, got 'replay'"):
            agent.save(tmp_path / "other", include=wrong)
    assert not (tmp_path / "other.zip").exists()


def test_learning_without_the_earlier_transitions_gives_a_warning(agent: ModelLearningAgent, tmp_path: Path) -> None:
    agent.save(tmp_path / "agent")
    loaded = ModelLearningAgent.load(tmp_path / "agent", env=gym.make(GEYSER, hit_cost=5.0))
    with pytest.warns(UserWarning, match="will replace what it knows"):
        loaded.learn(200, log_interval=None)


def test_a_custom_reward_must_be_given_again(agent: ModelLearningAgent, tmp_path: Path) -> None:
    env = gym.make(GEYSER)
    agent.set_reward(corner)
    expected, _ = agent.predict(observations())
    agent.save(tmp_path / "corner.zip")
    agent.set_reward(None)
    loaded = ModelLearningAgent.load(tmp_path / "corner.zip", env=env)
    with pytest.raises(ValueError, match="set_reward"):
        loaded.predict(observations())
    loaded.set_reward(corner)
    assert loaded.predict(observations())[0].tolist() == expected.tolist()
    again = ModelLearningAgent.load(tmp_path / "corner.zip", env=env, reward=corner)
    assert again.predict(observations())[0].tolist() == expected.tolist()


def test_parameters_can_be_transferred_between_agents(agent: ModelLearningAgent, tmp_path: Path) -> None:
    agent.save(tmp_path / "agent.zip")
    for source in (agent.get_parameters(), str(tmp_path / "agent.zip")):
        other = ModelLearningAgent("MctsPolicy", gym.make(GEYSER, hit_cost=5.0), seed=9)
        other.set_parameters(source)
        for name, value in agent.model.state_dict().items():
            np.testing.assert_array_equal(other.model.state_dict()[name], value)
        assert other.policy.fitted


def test_wrong_parameters_change_nothing(agent: ModelLearningAgent) -> None:
    before = agent.model.state_dict()
    wrong = agent.get_parameters()
    wrong["policy"] = {k: v[..., :1] if v.ndim else v for k, v in wrong["policy"].items()}
    with pytest.raises(ValueError, match="do not fit"):
        agent.set_parameters(wrong)
    for name, value in agent.model.state_dict().items():
        np.testing.assert_array_equal(before[name], value)


def test_the_file_holds_json_and_plain_arrays_only(agent: ModelLearningAgent) -> None:
    buffer = io.BytesIO()
    agent.save(buffer)
    with zipfile.ZipFile(buffer) as archive:
        assert json.loads(archive.read("data"))["policy_class"] == "MctsPolicy"
        for name in archive.namelist():
            assert name in {
                "data",
                "policy.npz",
                "planning.npz",
                "_stable_baselines3_version",
                "system_info.txt",
            }
            if name.endswith(".npz"):
                with np.load(io.BytesIO(archive.read(name)), allow_pickle=False) as arrays:
                    assert all(arrays[key].dtype != object for key in arrays.files)


def test_a_file_with_code_in_it_is_refused_by_the_entrys_name(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "pickle.zip", "w") as archive:
        archive.writestr("data", json.dumps({"format": checkpoint.FORMAT}))
        archive.writestr("policy.pth", b"")
    with pytest.raises(ValueError, match=r"\.pth.*pickle"):
        ModelLearningAgent.load(tmp_path / "pickle.zip")
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        archive.writestr("data", json.dumps({"settings": {":type:": "x", ":serialized:": "gASV"}}))
    with pytest.raises(ValueError, match="'settings'"):
        ModelLearningAgent.load(tmp_path / "evil.zip")


def test_a_file_of_another_algorithm_is_recognised(agent: ModelLearningAgent, tmp_path: Path) -> None:
    PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8).save(tmp_path / "ppo.zip")
    for load in (ModelLearningAgent.load, agent.set_parameters):
        with pytest.raises(ValueError, match=r"ppo\.zip was saved by another .* algorithm.*PPO\.load"):
            load(str(tmp_path / "ppo.zip"))


def test_missing_and_damaged_files_have_different_errors(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        ModelLearningAgent.load(tmp_path / "nowhere")
    (tmp_path / "noise.zip").write_bytes(b"noise")
    with pytest.raises(ValueError, match="damaged"):
        ModelLearningAgent.load(tmp_path / "noise.zip")


def test_custom_models_are_saved_only_when_registered(tmp_path: Path) -> None:
    world = TableWorld(random_table(5, 2, 0))
    agent = ModelLearningAgent("MctsPolicy", Corridor(), model=world)
    with pytest.raises(ValueError, match="register_model"):
        agent.save(tmp_path / "a.zip")
    register_model("my-model", build_graphs)
    named = ModelLearningAgent("MctsPolicy", Corridor(), model="my-model", seed=0)
    named.save(tmp_path / "b.zip")
    assert ModelLearningAgent.load(tmp_path / "b.zip").model_name == "my-model"


def test_transitions_can_be_transferred_in_plain_files(agent: ModelLearningAgent, tmp_path: Path) -> None:
    agent.save_transitions(str(tmp_path / "seen"))
    other = ModelLearningAgent("MctsPolicy", gym.make(GEYSER), seed=3)
    other.load_transitions(str(tmp_path / "seen"))
    np.testing.assert_array_equal(other.transitions.rows().next_states, agent.transitions.rows().next_states)
    with pytest.raises(ValueError, match="another environment"):
        ModelLearningAgent("MctsPolicy", Corridor()).load_transitions(str(tmp_path / "seen.npz"))
    assert len(other.transitions) == 3000
