"""Wraps environments as the VecEnv that the agent steps, and handles VecEnvs whose environments run in subprocesses.

Observations keep the environment's own layout. A worker process of SB3's SubprocVecEnv terminates at its first error, such as a
request for an attribute that is missing or cannot be pickled. Workers are therefore asked only for attributes that are known to
exist and to be picklable.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, unwrap_vec_normalize
from stable_baselines3.common.vec_env.patch_gym import _patch_env

from mbagent.spaces import ActionEnumeration, FactoredSpace, OutsideSpaceError, one_as_batch


def wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
    """Wraps environments as SB3 does, but without transposing the channels of image-like observations.

    Raises:
        TypeError: SB3 does not support this kind of environment; or the observation space has a Dict or Tuple inside another,
            which SB3's vector environments do not support (see wrappers.Flat).
        ValueError: the environment normalizes observations.
    """
    if not isinstance(env, VecEnv):
        _refuse_others(env)
        env = _patch_env(env)
        FactoredSpace(env.observation_space)  # raises a clear error before SB3's wrapper fails with another one
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
    """Checks and copies an environment's results, so that the environment may reuse its own arrays and dicts.

    SB3 keeps the last observation of an episode while it resets the environment. Without a copy, a reset that writes into the
    same array would replace that observation with the first one of the next episode.

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
            TypeError, ValueError: the environment returned values of the wrong type, number or range.
        """
        obs, info = self._checked_tuple(self.env.reset(seed=seed, options=options), "reset", "(observation, info)", 2)
        return self._checked_copy(obs), self._copied(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See gymnasium.Env; raises as ``reset``."""
        names = "(observation, reward, terminated, truncated, info)"
        obs, reward, terminated, truncated, info = self._checked_tuple(self.env.step(action), "step", names, 5)
        try:
            if np.ndim(reward):
                raise TypeError("an array")
            float(reward)
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"The environment's step returned the reward {reward!r} instead of one number; fix the environment."
            ) from error
        return self._checked_copy(obs), reward, terminated, truncated, self._copied(info)

    @staticmethod
    def _checked_tuple(returned: Any, method: str, names: str, n: int) -> tuple[Any, ...]:
        if isinstance(returned, tuple) and len(returned) == n:
            return returned
        got = f"{len(returned)} values" if isinstance(returned, tuple) else repr(returned)
        raise TypeError(f"The environment's {method} returned {got} instead of Gymnasium's {names}; fix the environment.")

    def _checked_copy(self, obs: Any) -> Any:
        space = self._space.space
        if isinstance(obs, list) or not space.contains(obs):  # the space's own check is fast, but rejects other data types
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
    """Raises an error that blames the environment for any observation outside the observation space.

    Raises:
        ValueError: an observation was outside the observation space.
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


ENDED = (
    "A process of the SubprocVecEnv has ended or was interrupted in a step, so its environments cannot be used any more (an "
    "error that an environment raised is printed above). The agent keeps the steps recorded so far: learn(0) fits it to them, "
    "and set_env(env) gives it a new environment."
)

LOOK_EVERY = 1.0
"""Seconds without an answer after which is checked whether the process is still running."""


@contextmanager
def naming_ended_processes(env: VecEnv) -> Iterator[None]:
    """Replaces the error from a subprocess's broken pipe with one that explains it; other errors pass unchanged.

    Raises:
        RuntimeError: a process of ``env`` has ended; the ``__cause__`` is the pipe error.
    """
    try:
        yield
    except (EOFError, ConnectionError) as error:
        if not isinstance(env.unwrapped, SubprocVecEnv):
            raise
        raise RuntimeError(ENDED) from error


def has_ended(env: VecEnv) -> bool:
    """Whether any subprocess of ``env`` has ended, or has sent an answer that an interrupted step did not read."""
    inner = env.unwrapped
    try:
        return isinstance(inner, SubprocVecEnv) and any(remote.poll() for remote in inner.remotes)
    except OSError:  # the pipe is broken or closed
        return True


def step(env: VecEnv, actions: Any) -> tuple[Any, Any, Any, Any]:
    """``env.step``, but raises instead of blocking forever if a subprocess has ended.

    Raises:
        RuntimeError: a process has ended.
    """
    inner = env.unwrapped
    if not isinstance(inner, SubprocVecEnv):
        return env.step(actions)
    with naming_ended_processes(env):
        env.step_async(actions)
        # Forked processes keep each other's pipes open, so reading from a process that has ended could block forever.
        for remote, process in zip(inner.remotes, inner.processes, strict=True):
            while not remote.poll(LOOK_EVERY):
                if not process.is_alive():
                    raise EOFError(f"The process {process.name} has ended without an answer.")
        return env.step_wait()


def own_reward(env: VecEnv) -> tuple[Any, str]:
    """(the first environment's ``reward_fn`` or None, the beginning of a sentence that says why it is None)."""
    missing = "The environment has no reward_fn"
    alone = not isinstance(env.unwrapped, SubprocVecEnv)
    try:
        if not alone and not env.env_method("has_wrapper_attr", "reward_fn", indices=0)[0]:
            return None, missing
        if alone or env.env_method("has_wrapper_attr", _IfPicklable("reward_fn"), indices=0)[0]:
            return env.get_attr("reward_fn", indices=0)[0], missing
    except Exception as error:  # missing, cannot be unpickled here, or the process has ended, which ``learn`` will report
        if alone and isinstance(error, AttributeError):
            return None, missing
        if alone:  # an error raised by the attribute itself
            return None, f"The environment's reward_fn cannot be read ({type(error).__name__}: {error})"
    return None, (
        "The environment's reward_fn cannot be pickled, as it must be to leave the environment's process (to plan with it, give "
        "the agent the function: reward=fn)"
    )


class _IfPicklable:
    """An attribute's name, which the subprocess unpickles as an empty string if the value cannot be pickled."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return _if_picklable, (self._name,)


def _if_picklable(name: str) -> str:
    # SB3's worker has no command for this. It unpickles a command's arguments inside the function that has the variable ``env``.
    frame = sys._getframe()
    while frame.f_back is not None and not isinstance(frame.f_locals.get("env"), gym.Env):
        frame = frame.f_back
    try:
        ForkingPickler.dumps(frame.f_locals["env"].get_wrapper_attr(name))
    except Exception:
        return ""
    return name


class EnvironmentAlgorithm(BaseAlgorithm):
    """SB3's base algorithm, adapted to environments whose steps or processes may fail and to checkpoints without code."""

    _recorder: Any = None

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return wrap_env(env, verbose, monitor_wrapper)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        """SB3's setup, except that it does not touch a failed environment if ``total_timesteps`` is 0."""
        assert self.env is not None
        rest = tb_log_name, progress_bar
        ended = has_ended(self.env)
        if total_timesteps > 0 and ended:
            raise RuntimeError(ENDED)
        if total_timesteps > 0 or not (ended or (self._recorder is not None and self._last_obs is None)):
            with naming_ended_processes(self.env):
                return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *rest)
        if reset_num_timesteps:
            self.num_timesteps = self._episode_num = 0
        self._last_obs = np.zeros(0)  # SB3 would reset the environment if this were None
        try:
            return super()._setup_learn(0, callback, False, *rest)
        finally:
            self._last_obs = None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "policy", "transitions", "goals"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []
