"""Tests of the agent: the behaviour that SB3 expects of an algorithm, and reward-free model learning."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import mbagent
from mbagent import ModelLearningAgent
from tests.worlds import Corridor

GEYSER = "mbagent/GeyserRunner-v0"


@pytest.fixture(scope="module")
def runner() -> ModelLearningAgent:
    """An agent that has learned GeyserRunner with a high cost."""
    return ModelLearningAgent("MctsPolicy", gym.make(GEYSER, hit_cost=5.0), seed=0).learn(20_000, log_interval=None)


def corridor_agent(**kwargs: Any) -> ModelLearningAgent:
    return ModelLearningAgent("MctsPolicy", Corridor(limit=30), seed=1, **kwargs)


def weights(agent: ModelLearningAgent) -> bytes:
    return b"".join(value.tobytes() for _, value in sorted(agent.model.state_dict().items()))


def test_it_plays_the_game_it_learned_without_reward(runner: ModelLearningAgent) -> None:
    env = make_vec_env(GEYSER, n_envs=5, seed=7, env_kwargs={"hit_cost": 5.0})
    mean, _ = evaluate_policy(runner, env, n_eval_episodes=5)
    assert float(np.mean(mean)) > 40.0  # the optimum is 43.8, random play 4.8


def play(agent: ModelLearningAgent, steps: int, seed: int, **arguments: Any) -> NDArray[np.int64]:
    """Columns visited in one episode of GeyserRunner."""
    env = gym.make(GEYSER, **arguments)
    obs, _ = env.reset(seed=seed)
    columns = []
    for _ in range(steps):
        action, _ = agent.predict(obs, deterministic=True)
        obs, *_ = env.step(action)
        columns.append(int(obs[:10].argmax()))
    return np.array(columns)


def test_the_papers_two_behaviours_in_the_stochastic_geysers(runner: ModelLearningAgent) -> None:
    # Paper 4.3: the agent "will either go straight right or sit in the safe zone indefinitely".
    columns = play(runner, 60, 3, hit_cost=5.0)
    assert columns.max() == 4
    assert (columns[5:] == 4).all()
    runner.set_reward(gym.make(GEYSER, hit_cost=1.0).get_wrapper_attr("reward_fn"))
    columns = play(runner, 60, 3, hit_cost=1.0)
    assert columns[:9].tolist() == list(range(1, 10))
    assert (columns[9:] == 9).all()
    runner.set_reward(None)


def test_a_new_goal_needs_no_step_and_changes_no_weight(runner: ModelLearningAgent) -> None:
    steps, before = runner.num_timesteps, weights(runner)
    runner.set_reward(lambda obs, action, next_obs: next_obs[:, 0])
    env = make_vec_env(GEYSER, n_envs=2, seed=3)
    obs: Any = env.reset()
    for _ in range(20):
        actions, _ = runner.predict(obs)
        obs, *_ = env.step(actions)
    assert obs[:, 0].all()
    runner.set_reward(None)
    assert (runner.num_timesteps, weights(runner)) == (steps, before)


class NoisyRewards(gym.Wrapper[Any, Any, Any, Any]):
    """Replaces every reward by noise."""

    def step(self, action: Any) -> Any:
        obs, _, terminated, truncated, info = self.env.step(action)
        return obs, float(np.random.default_rng().normal()), terminated, truncated, info


def test_rewards_leave_no_trace_in_the_transition_model() -> None:
    def learned(env: gym.Env[Any, Any]) -> ModelLearningAgent:
        return ModelLearningAgent("MctsPolicy", env, seed=4, reward=lambda obs, action, next_obs: next_obs[:, 0]).learn(
            1500, log_interval=None
        )

    honest, noisy = learned(gym.make(GEYSER)), learned(NoisyRewards(gym.make(GEYSER)))
    assert weights(honest) == weights(noisy)
    assert not np.array_equal(honest.transitions.rows().rewards, noisy.transitions.rows().rewards)


def test_predictions_do_not_depend_on_the_batch(runner: ModelLearningAgent) -> None:
    obs = np.stack([gym.make(GEYSER).reset(seed=s)[0] for s in range(6)])
    together, _ = runner.predict(obs, deterministic=True)
    alone = [int(runner.predict(one, deterministic=True)[0]) for one in obs]
    assert together.tolist() == alone
    assert runner.predict(obs[0])[0].shape == ()


def test_no_reset_is_learned_as_a_transition() -> None:
    env = DummyVecEnv([lambda: Monitor(Corridor(limit=7)), lambda: Monitor(Corridor(limit=11))])
    with pytest.warns(UserWarning, match="no reward_fn"):
        agent = ModelLearningAgent("MctsPolicy", env, seed=0).learn(2000, log_interval=None)
    rows = agent.transitions.rows()
    assert (np.abs(rows.next_states - rows.states) <= 1).all()
    np.testing.assert_array_equal(rows.terminated, rows.next_states[:, 0] == 4)
    for episode in np.unique(rows.episodes):
        part = rows.select(rows.episodes == episode)
        np.testing.assert_array_equal(part.states[1:], part.next_states[:-1])
        assert part.states[0, 0] == 0


def test_reward_and_termination_are_learned_without_a_reward_function() -> None:
    with pytest.warns(UserWarning, match="no reward_fn"):
        agent = corridor_agent().learn(3000, log_interval=None)
    assert agent.goals.source == "learned"
    assert [int(agent.predict(np.array(s))[0]) for s in range(4)] == [1, 1, 1, 1]
    plan = agent.policy.plan(np.array([[3]]))
    assert plan.values[0, 1] == pytest.approx(1.0, abs=0.02)  # no rewards after termination


def test_rewards_are_learned_as_the_environment_gave_them_despite_wrappers() -> None:
    env = VecNormalize(DummyVecEnv([Corridor]), norm_obs=False, norm_reward=True)
    with pytest.warns(UserWarning, match="no reward_fn"):
        agent = ModelLearningAgent("MctsPolicy", env, seed=0).learn(2000, log_interval=None)
    assert set(np.unique(agent.transitions.rows().rewards)) == {0.0, 1.0}
    assert int(agent.predict(np.array(3))[0]) == 1


def test_learning_continues_from_the_last_call() -> None:
    agent = corridor_agent(reward=lambda obs, action, next_obs: (next_obs == 4).astype(float)).learn(400, log_interval=None)
    agent.learn(300, log_interval=None, reset_num_timesteps=False)
    assert agent.num_timesteps == 700
    assert len(agent.transitions) == 700
    rows = agent.transitions.rows()
    assert rows.episodes.tolist() == sorted(rows.episodes.tolist())


class StopAt(BaseCallback):
    def __init__(self, calls: int) -> None:
        super().__init__()
        self.stop_at = calls

    def _on_step(self) -> bool:
        return self.n_calls < self.stop_at


def test_a_run_stopped_by_a_callback_still_fits() -> None:
    with pytest.warns(UserWarning, match="no reward_fn"):
        agent = corridor_agent().learn(10_000, callback=StopAt(500), log_interval=None)
    assert len(agent.transitions) == 500
    assert agent.policy.fitted


def test_callbacks_that_predict_and_save_work_before_the_first_fit(tmp_path: Any) -> None:
    agent = corridor_agent(reward=lambda obs, action, next_obs: (next_obs == 4).astype(float))
    callbacks = [
        EvalCallback(Monitor(Corridor(limit=30)), eval_freq=200, n_eval_episodes=2, verbose=0, warn=False),
        CheckpointCallback(save_freq=200, save_path=str(tmp_path)),
    ]
    with pytest.warns(UserWarning, match="learned nothing yet") as caught:
        agent.learn(500, callback=callbacks, log_interval=None)
    assert len([w for w in caught if "learned nothing yet" in str(w.message)]) == 1
    assert len(list(tmp_path.glob("*.zip"))) == 2


def test_the_log_contains_the_documented_figures(runner: ModelLearningAgent) -> None:
    from stable_baselines3.common.logger import KVWriter, Logger  # noqa: PLC0415 - only this test needs it

    class Memory(KVWriter):
        def __init__(self) -> None:
            self.seen: set[str] = set()

        def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
            self.seen |= set(key_values)

        def close(self) -> None:
            pass

    memory = Memory()
    agent = corridor_agent(reward=lambda obs, action, next_obs: 0.0 * next_obs)
    agent.set_logger(Logger(None, [memory]))
    agent.learn(300)
    expected = {
        "train/predictor_loss",
        "train/exact_match",
        "rollout/ep_rew_mean",
        "time/fps",
        "model/transitions",
    }
    assert expected | {"plan/start_value"} <= memory.seen


@pytest.mark.parametrize("policy", ["MctsPolicy", "MlpPolicy", "FlatMonteCarloPolicy", "ValueIterationPolicy"])
def test_every_planner_plays(policy: str) -> None:
    agent = ModelLearningAgent(
        policy, Corridor(limit=30), seed=0, reward=lambda obs, action, next_obs: (next_obs == 4).astype(float)
    ).learn(1500, log_interval=None)
    assert int(agent.predict(np.array(3))[0]) == 1


def test_an_agent_on_the_true_model_needs_no_learning() -> None:
    from mbagent.models import SimulatorModel  # noqa: PLC0415 - only this test needs it

    env = gym.make(GEYSER, hit_cost=5.0)
    agent = ModelLearningAgent("MctsPolicy", env, seed=0, model=SimulatorModel(env.get_wrapper_attr("game")))
    assert play(agent, 30, 0, hit_cost=5.0).max() == 4


@pytest.mark.parametrize(
    ("make", "kwargs", "message"),
    [
        (lambda: gym.make("CartPole-v1"), {}, "DiscretizeObservation"),
        (lambda: gym.make("Pendulum-v1"), {}, "Discretize"),
        (lambda: gym.make(GEYSER), {"model": "papper"}, "papper"),
        (lambda: gym.make(GEYSER), {"exploration": "bold"}, "bold"),
        (lambda: gym.make(GEYSER), {"policy_kwargs": {"depth": 3}}, "depth"),
        (lambda: gym.make(GEYSER), {"gamma": 1.0}, "gamma"),
    ],
)
def test_bad_arguments_are_refused_in_one_sentence(make: Callable[[], Any], kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        ModelLearningAgent("MctsPolicy", make(), **kwargs)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (lambda obs, action, next_obs: 1.0, "shape"),
        (lambda obs, action, next_obs: next_obs, "shape"),
        (lambda obs, action, next_obs: np.full(len(obs), np.nan), "NaN"),
        (lambda obs, action, next_obs: np.full(len(obs), -1e300), "scale them down"),
        (lambda obs, action, next_obs: None, "shape|numbers|NaN"),
        ("fast", "function"),
    ],
)
def test_a_bad_reward_is_refused_and_the_old_goal_stays(runner: ModelLearningAgent, reward: Any, message: str) -> None:
    obs = gym.make(GEYSER).reset(seed=0)[0]
    before = runner.policy.plan(runner.policy.factored.encode(obs[None])).values
    with pytest.raises((TypeError, ValueError), match=message):
        runner.set_reward(reward)
    np.testing.assert_array_equal(runner.policy.plan(runner.policy.factored.encode(obs[None])).values, before)


@pytest.mark.parametrize("obs", [np.zeros(14, dtype=np.int8), np.full(15, 3, dtype=np.int8), np.full(15, 0.5)])
def test_an_observation_outside_the_space_is_refused(runner: ModelLearningAgent, obs: NDArray[Any]) -> None:
    with pytest.raises(ValueError, match="observation"):
        runner.predict(obs)


def test_version_and_games_are_available() -> None:
    assert mbagent.__version__
    assert GEYSER in gym.registry


def test_exploration_draws_other_numbers_than_an_environment_of_the_same_seed() -> None:
    class Die(gym.Env[Any, Any]):
        observation_space = gym.spaces.Discrete(4)
        action_space = gym.spaces.Discrete(4)

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
            super().reset(seed=seed)
            return 0, {}

        def step(self, action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
            return int(self.np_random.integers(4)), 0.0, False, False, {}

    agent = ModelLearningAgent("MctsPolicy", Die(), reward=lambda obs, action, next_obs: np.zeros(len(obs)), seed=0)
    rows = agent.learn(2000, log_interval=None).transitions.rows()
    assert abs((rows.actions == rows.next_states[:, 0]).mean() - 0.25) < 0.06
