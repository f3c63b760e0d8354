"""How an environment becomes the VecEnv that the agent steps; observations keep the environment's own layout."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize
from stable_baselines3.common.vec_env.patch_gym import _patch_env

from mbagent.leaves import OutsideSpaceError
from mbagent.policies import one_as_batch
from mbagent.spaces import ActionEnumeration, FactoredSpace


def wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
    """As SB3 wraps environments, but without moving the channels of image-like observations.

    Raises:
        TypeError: it is no environment that SB3 takes; or the observation space is nested deeper than SB3's vector
            environments can carry, see wrappers.Flat.
        ValueError: it normalizes observations.
    """
    if not isinstance(env, VecEnv):
        _refuse_others(env)
        env = _patch_env(env)
        FactoredSpace(env.observation_space)  # refuses in one sentence what SB3's wrapper would stumble over
        ActionEnumeration(env.action_space)
        _refuse_nested(env.observation_space)
        env = Guarded(env)
        if monitor_wrapper and not is_wrapped(env, Monitor):
            env = Monitor(env)
        if verbose >= 1:
            print("Wrapping the env in a Monitor and a DummyVecEnv.")  # noqa: T201 - as SB3 does
        single = env
        env = DummyVecEnv([lambda: single])
    normalized = unwrap_vec_normalize(env)
    if normalized is not None and normalized.norm_obs:
        raise ValueError(
            "VecNormalize makes the observations continuous, but this agent models discrete ones; turn that off: "
            "VecNormalize(env, norm_obs=False)."
        )
    return env


class Guarded(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """An environment whose results are checked, and copied, so that it may use its arrays and dicts again.

    SB3 keeps the last observation of an episode while the environment is reset; without a copy, a reset that clears the
    environment's own array would turn it into the first of the next.

    Args:
        env: an environment with discrete spaces (see FactoredSpace).
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """See the class."""
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._space = FactoredSpace(env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env.

        Raises:
            TypeError, ValueError: the environment returned something else than it should.
        """
        obs, info = self._parts(self.env.reset(seed=seed, options=options), "reset", "(observation, info)", 2)
        return self._own(obs), self._copied(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As ``reset``."""
        names = "(observation, reward, terminated, truncated, info)"
        obs, reward, terminated, truncated, info = self._parts(self.env.step(action), "step", names, 5)
        try:
            float(reward)
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"The environment's step returned the reward {reward!r} instead of one number; fix the environment."
            ) from error
        return self._own(obs), reward, terminated, truncated, self._copied(info)

    @staticmethod
    def _parts(returned: Any, method: str, names: str, n: int) -> tuple[Any, ...]:
        if isinstance(returned, tuple) and len(returned) == n:
            return returned
        got = f"{len(returned)} values" if isinstance(returned, tuple) else repr(returned)
        raise TypeError(f"The environment's {method} returned {got} instead of Gymnasium's {names}; fix the environment.")

    def _own(self, obs: Any) -> Any:
        space = self._space.space
        if isinstance(obs, list) or not space.contains(obs):  # the space's own check is quick, but refuses other data types
            with blaming_environment():
                self._space.encode(one_as_batch(space, obs))
        return deepcopy(obs)

    @staticmethod
    def _copied(info: Any) -> dict[str, Any]:
        if isinstance(info, dict):
            return dict(info)
        raise TypeError(f"The environment returned the info {info!r} instead of a dict; fix the environment.")


@contextmanager
def blaming_environment() -> Iterator[None]:
    """Observations that do not fit their space are the environment's mistake here, and errors say so.

    Raises:
        ValueError: one did not fit.
    """
    try:
        yield
    except OutsideSpaceError as error:
        raise ValueError(
            f"The environment violates its own observation_space: {error.cause[0].lower()}{error.cause[1:]}; "
            "fix that space, or what reset and step return."
        ) from error


def _refuse_others(env: Any) -> None:
    if isinstance(env, gym.vector.VectorEnv):
        raise TypeError(
            f"env is a vector environment of Gymnasium ({type(env).__name__}), but SB3's algorithms take only SB3's; create it "
            "with stable_baselines3.common.env_util.make_vec_env(id, n_envs=...) instead of gym.make_vec."
        )
    if isinstance(env, type) or not callable(getattr(env, "step", None)):
        raise TypeError(f"env must be a Gymnasium environment, a VecEnv of SB3 or a registered id, got {env!r}.")


def _refuse_nested(space: spaces.Space[object]) -> None:
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        return
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
    if any(isinstance(part, spaces.Dict | spaces.Tuple) for part in parts):
        raise TypeError(
            "The observation space is nested (a Dict or Tuple inside another), which SB3's vector environments cannot carry; "
            "wrap the environment: mbagent.wrappers.Flat(env)."
        )
