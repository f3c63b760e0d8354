"""The learned model as an environment."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.evaluation import evaluate_policy

from mbagent import LearnedEnv, ModelLearningAgent
from tests.agent.test_drop_in import Bytes, Converted
from tests.worlds import Corridor

ON_CHECKS = pytest.mark.filterwarnings("ignore:.*render", "ignore:.*unwrapped version")


def learned(env: gym.Env[Any, Any], reward: Any = None, steps: int = 400) -> ModelLearningAgent:
    if reward is not None:
        return ModelLearningAgent("MctsPolicy", env, seed=0, reward=reward).learn(steps)
    with pytest.warns(UserWarning, match="reward_fn"):
        return ModelLearningAgent("MctsPolicy", env, seed=0).learn(steps)


def played(env: gym.Env[Any, Any], seed: int) -> list[Any]:
    rng, (obs, _) = np.random.default_rng(0), env.reset(seed=seed)
    seen: list[Any] = [obs]
    for _ in range(30):
        step = env.step(int(rng.integers(2)))
        seen.append(step[:4])
        if step[2] or step[3]:
            seen.append(env.reset()[0])
    return seen


@ON_CHECKS
@pytest.mark.parametrize("kind", ["number", "bytes", "tuple"])
def test_it_passes_the_checks_of_gymnasium_and_sb3(kind: str) -> None:
    worlds = {
        "number": Corridor(limit=50),
        "bytes": Bytes(Corridor(limit=50)),
        "tuple": Converted(spaces.Tuple((spaces.Discrete(2), spaces.Discrete(3))), lambda at: (at % 2, at // 2)),
    }
    env = LearnedEnv(learned(worlds[kind]), max_episode_steps=20)
    assert env.observation_space == worlds[kind].observation_space
    check_env(env, skip_render_check=True)
    if kind != "tuple":  # not supported by SB3's checker
        sb3_check_env(env)


def test_it_equals_a_fully_observed_environment() -> None:
    real, env = Corridor(limit=50), LearnedEnv(learned(Corridor(limit=50)), max_episode_steps=50)
    assert played(env, 1) == played(real, 1)  # a deterministic environment: steps, rewards, terminations
    assert env.reset(seed=3)[1] == {}


class Coin(Corridor):
    """Starts at 0 three times as often as at 2; steps move at random."""

    def reset(self, **kwargs: Any) -> Any:
        _, info = super().reset(**kwargs)
        self.at = 2 * int(self.np_random.random() < 0.25)
        return self.at, info

    def step(self, action: int) -> Any:
        return super().step(int(self.np_random.random() < 0.7) if action else 0)


def test_start_states_and_random_steps_have_the_observed_frequencies() -> None:
    env = LearnedEnv(learned(Coin(limit=10), lambda obs, action, next_obs: next_obs, steps=6000), max_episode_steps=10)
    starts = np.array([env.reset(seed=i)[0] for i in range(400)])
    assert set(starts) == {0, 2}
    assert abs((starts == 2).mean() - 0.25) < 0.08
    moved = []
    for seed in range(400):
        obs, _ = env.reset(seed=seed)
        following, reward, *_ = env.step(1)
        assert reward == following
        moved.append(following > obs)
    assert abs(np.mean(moved) - 0.7) < 0.08
    assert played(env, 7) == played(env, 7)
    assert played(env, 7) != played(env, 8)


def test_any_reward_can_be_used() -> None:
    agent = learned(Corridor(limit=50))
    weights = agent.get_parameters()["policy"]
    env = LearnedEnv(agent, lambda obs, action, next_obs: -1.0 * (next_obs == 1), max_episode_steps=5)
    env.reset(seed=0)
    assert env.step(1)[1] == -1.0
    *_, terminated, truncated, _ = [env.step(0) for _ in range(4)][-1]
    assert (terminated, truncated) == (False, True)
    agent.set_reward(lambda obs, action, next_obs: 5.0 * (next_obs == 1))
    env = LearnedEnv(agent)  # the agent's current goal
    env.reset(seed=0)
    assert env.step(1)[1] == 5.0
    for name, value in agent.get_parameters()["policy"].items():
        np.testing.assert_array_equal(value, weights[name])


def test_ppo_trained_in_it_plays_the_real_world() -> None:
    env = LearnedEnv(learned(Corridor(limit=50)), max_episode_steps=20)
    ppo = PPO("MlpPolicy", env, n_steps=128, batch_size=64, learning_rate=3e-3, seed=0, device="cpu").learn(3000)
    score, _ = evaluate_policy(ppo, gym.wrappers.TimeLimit(Corridor(), 20), n_eval_episodes=3, warn=False)
    assert score == 1.0


def test_mistakes_are_named() -> None:
    fresh = ModelLearningAgent("MctsPolicy", Corridor(), seed=0)
    with pytest.raises(ValueError, match="learned nothing"):
        LearnedEnv(fresh)
    agent = learned(Corridor(limit=50))
    with pytest.raises(ValueError, match="max_episode_steps"):
        LearnedEnv(agent, max_episode_steps=0)
    with pytest.raises(TypeError, match="function"):
        LearnedEnv(agent, 3)  # type: ignore[arg-type]
    env = LearnedEnv(agent)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    with pytest.raises(ValueError, match="options"):
        env.reset(options={"nonsense": 1})


@pytest.mark.parametrize("agent", [None, "agent.zip"])
def test_an_invalid_agent_is_refused(agent: Any) -> None:
    with pytest.raises(TypeError, match="LearnedEnv needs an agent"):
        LearnedEnv(agent)


@pytest.mark.parametrize("action", [None, "x", 7, np.zeros((2, 3))])
def test_a_wrong_action_is_called_an_action(action: Any) -> None:
    env = LearnedEnv(learned(Corridor(limit=50)))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^The action "):
        env.step(action)
    with pytest.raises(ValueError, match="takes one action, got a batch of 2"):
        env.step(np.array([0, 1]))
