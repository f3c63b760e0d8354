"""How an environment becomes the VecEnv that the agent steps; observations keep the environment's own layout."""

from __future__ import annotations

from gymnasium import spaces
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.patch_gym import _patch_env

from mbagent.spaces import ActionEnumeration, FactoredSpace


def wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
    """As SB3 wraps environments, but without moving the channels of image-like observations.

    Raises:
        TypeError: the observation space is nested deeper than SB3's vector environments can carry; see wrappers.Flat.
    """
    if not isinstance(env, VecEnv):
        env = _patch_env(env)
        FactoredSpace(env.observation_space)  # refuses in one sentence what SB3's wrapper would stumble over
        ActionEnumeration(env.action_space)
        _refuse_nested(env.observation_space)
        if monitor_wrapper and not is_wrapped(env, Monitor):
            env = Monitor(env)
        if verbose >= 1:
            print("Wrapping the env in a Monitor and a DummyVecEnv.")  # noqa: T201 - as SB3 does
        single = env
        env = DummyVecEnv([lambda: single])
    return env


def _refuse_nested(space: spaces.Space[object]) -> None:
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        return
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
    if any(isinstance(part, spaces.Dict | spaces.Tuple) for part in parts):
        raise TypeError(
            "The observation space is nested (a Dict or Tuple inside another), which SB3's vector environments cannot carry; "
            "wrap the environment: mbagent.wrappers.Flat(env)."
        )
