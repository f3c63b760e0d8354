"""Invalid arguments raise an error of one sentence that names the mistake and the fix, and change nothing."""

import io
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mbagent_envs  # noqa: F401  (registers the games)
from mbagent import ModelLearningAgent
from tests.worlds import Corridor

GEYSER = "mbagent/GeyserRunner-v0"


@pytest.fixture(scope="module")
def runner() -> ModelLearningAgent:
    return ModelLearningAgent("MctsPolicy", gym.make(GEYSER), seed=0).learn(1500, log_interval=None)


@pytest.mark.parametrize("steps", [-5, 2.5, float("nan"), True, "x", None])
def test_invalid_numbers_of_steps_are_refused(runner: ModelLearningAgent, steps: Any) -> None:
    before = len(runner.transitions)
    with pytest.raises(ValueError, match="total_timesteps must be a whole number"):
        runner.learn(steps)
    assert len(runner.transitions) == before


def test_steps_may_be_whole_floats_and_zero_fits_earlier_transitions() -> None:
    agent = ModelLearningAgent("MctsPolicy", gym.make(GEYSER), seed=0, model="tabular").learn(2e2, log_interval=None)  # type: ignore[arg-type]
    assert agent.num_timesteps == 200
    agent.learn(0, log_interval=None)
    assert len(agent.transitions) == 200


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"gamma": "x"}, ValueError, "gamma must be a finite number"),
        ({"policy_kwargs": {"c_uct": float("nan")}}, ValueError, "c_uct must be a finite number"),
        ({"policy_kwargs": {"depth": 3}}, TypeError, "has no 'depth'; it takes"),
        ({"exploration": 5}, TypeError, "exploration must be a name or an object"),
        ({"learning_rate": -1.0}, ValueError, "learning_rate must be a finite number above 0"),
        ({"learning_rate": float("nan")}, ValueError, "learning_rate must be a finite number above 0"),
        ({"model": 5}, TypeError, "model must be 'auto'"),
        ({"seed": -1}, ValueError, "seed must be a whole number from 0"),
        ({"seed": "x"}, ValueError, "seed must be a whole number from 0"),
        ({"device": "tpu9"}, ValueError, "device must be 'auto', 'cpu' .* got 'tpu9'"),
        ({"device": None}, ValueError, "device must be 'auto'"),
        ({"policy_kwargs": 5}, TypeError, "policy_kwargs must be a dict"),
    ],
)
def test_settings_are_checked_when_the_agent_is_built(kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ModelLearningAgent("MctsPolicy", gym.make(GEYSER), **kwargs)


@pytest.mark.parametrize("policy", ["PpoPolicy", None, 5])
def test_an_unknown_policy_lists_the_known_ones(policy: Any) -> None:
    with pytest.raises(ValueError, match=r"policy must be one of .*'FlatMonteCarloPolicy', 'MctsPolicy'.* got "):
        ModelLearningAgent(policy, gym.make(GEYSER))


@pytest.mark.parametrize("callback", [5, "x", [5], [None], [lambda local, world: True]])
def test_invalid_callbacks_are_refused_before_a_step(runner: ModelLearningAgent, callback: Any) -> None:
    with pytest.raises(TypeError, match="callback must be a BaseCallback"):
        runner.learn(10, callback=callback)
    assert runner.num_timesteps == 1500


@pytest.mark.parametrize("package", ["rich", "tqdm"])
def test_a_progress_bar_without_its_package_is_refused_before_a_step(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    agent = ModelLearningAgent("MctsPolicy", gym.make(GEYSER))
    with pytest.raises(ImportError, match=rf'package {package}: pip install "mbagent\[progress\]"'):
        agent.learn(10, progress_bar=True)
    assert agent.num_timesteps == 0


def test_no_steps_and_nothing_to_fit_is_refused() -> None:
    with pytest.raises(ValueError, match=r"learn\(0\) only fits the transitions collected so far, and there are none"):
        ModelLearningAgent("MctsPolicy", gym.make(GEYSER)).learn(0)


def test_the_tuple_that_reset_or_step_returns_is_no_observation(runner: ModelLearningAgent) -> None:
    env = gym.make(GEYSER)
    with pytest.raises(ValueError, match=r"whole tuple that reset\(\) returned; pass its first element"):
        runner.predict(env.reset())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"whole tuple that step\(\) returned"):
        runner.explain(env.step(0))


def test_numpy_numbers_are_accepted() -> None:
    settings: dict[str, Any] = {"seed": np.int64(3), "num_simulations": np.int64(8), "gamma": np.float64(0.9)}
    agent = ModelLearningAgent("MctsPolicy", gym.make(GEYSER), **settings)
    assert agent.policy.settings.num_simulations == 8


def test_a_missing_environment_is_refused() -> None:
    with pytest.raises(ValueError, match="env must be an environment"):
        ModelLearningAgent("MctsPolicy", None)


class Odd(Corridor):
    def __init__(self, observation: spaces.Space[Any] | None = None, action: spaces.Space[Any] | None = None) -> None:
        super().__init__()
        self.observation_space = self.observation_space if observation is None else observation
        self.action_space = self.action_space if action is None else action


@pytest.mark.parametrize(
    ("env", "error", "message"),
    [
        (Odd(spaces.Text(5)), TypeError, "is not discrete"),
        (Odd(spaces.Dict({})), ValueError, "holds no variable"),
        (Odd(action=spaces.Dict({"a": spaces.Discrete(2)})), TypeError, "make it one MultiDiscrete"),
        (Odd(action=spaces.Tuple([spaces.Discrete(2)])), TypeError, "make it one MultiDiscrete"),
    ],
)
def test_unsupported_spaces_are_refused_before_other_errors(env: Corridor, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ModelLearningAgent("MctsPolicy", env)


def test_an_empty_batch_has_no_actions(runner: ModelLearningAgent) -> None:
    assert runner.predict(np.zeros((0, 15), dtype=np.int8))[0].shape == (0,)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (lambda obs, action, next_obs: None, "is a return missing"),
        (lambda obs, action, next_obs: np.array(["1"] * len(action)), "array of numbers"),
        (lambda obs, action, next_obs: np.ones(len(action)) * 1j, "array of numbers"),
        (lambda obs, action: np.ones(len(action)), r"called as fn\(obs, action, next_obs\)"),
    ],
)
def test_invalid_reward_functions_are_refused(runner: ModelLearningAgent, reward: Callable[..., Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        runner.set_reward(reward)
    assert runner.goals.source == "environment"


class PaysNaN(Corridor):
    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        return super().step(action)[0], float("nan"), False, False, {}


def test_a_reward_of_nan_is_refused_when_it_is_observed() -> None:
    with pytest.raises(ValueError, match="returned a reward of NaN"):
        ModelLearningAgent("MctsPolicy", PaysNaN(), seed=0).learn(10)


def test_weights_that_fit_only_in_part_change_nothing(runner: ModelLearningAgent) -> None:
    before = runner.policy.arrays()
    wrong = {name: value.clone() for name, value in runner.get_parameters()["policy"].items()}
    for name, value in wrong.items():
        if name.startswith("model.") and value.is_floating_point():
            value.zero_()
    last = max(name for name in wrong if name.startswith("reward.network"))
    with pytest.raises(ValueError, match="none was taken over"):
        runner.set_parameters({"policy": {**wrong, last: wrong[last][:0]}})
    with pytest.raises(ValueError, match="holds NaN"):
        runner.set_parameters({"policy": {**wrong, last: wrong[last] * float("nan")}})
    after = runner.policy.arrays()
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_learning_continues_after_loading_without_the_custom_goal(runner: ModelLearningAgent, tmp_path: Path) -> None:
    runner.set_reward(lambda obs, action, next_obs: next_obs[:, 0])
    runner.save(tmp_path / "left.zip", include=["transitions"])
    runner.set_reward(None)
    loaded = ModelLearningAgent.load(tmp_path / "left.zip", env=gym.make(GEYSER))
    loaded.learn(200, log_interval=None)
    with pytest.raises(ValueError, match="custom reward"):
        loaded.predict(np.zeros(15, dtype=np.int8))


def test_a_new_environment_that_changes_rewards_is_reported(runner: ModelLearningAgent, tmp_path: Path) -> None:
    runner.save(tmp_path / "agent.zip")
    negated = gym.wrappers.TransformReward(gym.make(GEYSER), lambda reward: -float(reward))
    with pytest.warns(UserWarning, match="TransformReward changes the environment's rewards"):
        loaded = ModelLearningAgent.load(tmp_path / "agent.zip", env=negated)
    assert loaded.goals.source == "environment"


def test_policies_are_saved_with_their_agent(runner: ModelLearningAgent, tmp_path: Path) -> None:
    with pytest.raises(NotImplementedError, match=r"agent\.save"):
        runner.policy.save(tmp_path / "policy.zip")
    with pytest.raises(NotImplementedError, match=r"ModelLearningAgent\.load"):
        type(runner.policy).load(tmp_path / "policy.zip")


def edited(path: Path, change: Callable[[dict[str, bytes]], None]) -> io.BytesIO:
    """A copy of the file with changed entries."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    change(entries)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, value in entries.items():
            archive.writestr(name, value)
    buffer.seek(0)
    return buffer


def with_data(**changes: Any) -> Callable[[dict[str, bytes]], None]:
    def change(entries: dict[str, bytes]) -> None:
        data = json.loads(entries["data"])
        data.update(changes)
        entries["data"] = json.dumps({name: value for name, value in data.items() if value != "gone"}).encode()

    return change


def replaced(name: str, value: bytes | None) -> Callable[[dict[str, bytes]], None]:
    def change(entries: dict[str, bytes]) -> None:
        del entries[name]
        if value is not None:
            entries[name] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_data(settings="gone"), "lacks settings"),
        (with_data(settings=None), "damaged"),
        (with_data(reward_source="zzz"), "damaged"),
        (with_data(planning_seed="gone", model="gone"), "lacks model, planning_seed"),
        (replaced("policy.npz", None), r"lacks policy\.npz"),
        (replaced("policy.npz", b""), "damaged"),
        (replaced("data", b"\xff\xfe"), "damaged"),
    ],
)
def test_a_damaged_file_is_called_damaged(
    runner: ModelLearningAgent, tmp_path: Path, change: Callable[[dict[str, bytes]], None], message: str
) -> None:
    runner.save(tmp_path / "agent.zip")
    with pytest.raises(ValueError, match=message):
        ModelLearningAgent.load(edited(tmp_path / "agent.zip", change))


def test_a_folder_of_the_same_name_does_not_hide_the_file(runner: ModelLearningAgent, tmp_path: Path) -> None:
    (tmp_path / "agent").mkdir()
    runner.save(tmp_path / "agent")
    assert ModelLearningAgent.load(tmp_path / "agent", env=gym.make(GEYSER)).policy.fitted
    with pytest.raises(TypeError, match="from a path or an open binary file"):
        ModelLearningAgent.load(None)  # type: ignore[arg-type]


def test_settings_with_names_of_the_version_before_work_with_a_warning() -> None:
    old = {"wave": 4, "leaf_values": "machine"}
    with pytest.warns(DeprecationWarning, match="is now called") as warned:
        agent = ModelLearningAgent("MctsPolicy", gym.make(GEYSER), seed=0, policy_kwargs=old)
    assert (agent.policy.settings.batch_size, agent.policy.settings.leaf_values) == (4, "lookahead")
    assert [str(w.message) for w in warned] == [
        "policy_kwargs: 'wave' is now called 'batch_size'.",
        "policy_kwargs: leaf_values='machine' is now called 'lookahead'.",
    ]
