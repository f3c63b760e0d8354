"""Environments in processes of their own (SB3's SubprocVecEnv): how to ask them without ending them, and to see that one ended.

The worker process of an environment ends with the first error, be it that an attribute is missing or cannot be pickled.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

ENDED = (
    "A process of the SubprocVecEnv has ended or was interrupted in a step, so its environments cannot be used any more (an "
    "error that an environment raised is printed above). The agent keeps the steps recorded so far: learn(0) fits it to them, "
    "and set_env(env) gives it a new environment."
)

LOOK_EVERY = 1.0
"""Seconds without an answer after which it is checked whether the process still runs."""


@contextmanager
def naming_ended_processes(env: VecEnv) -> Iterator[None]:
    """Says in a sentence what the error of a broken pipe means; errors of environments in this process pass unchanged.

    Raises:
        RuntimeError: a process of ``env`` has ended; the cause is the error of its pipe.
    """
    try:
        yield
    except (EOFError, ConnectionError) as error:
        if not isinstance(env.unwrapped, SubprocVecEnv):
            raise
        raise RuntimeError(ENDED) from error


def has_ended(env: VecEnv) -> bool:
    """Whether the environments are in processes of their own of which one has ended, or owes an answer that nobody waits for."""
    inner = env.unwrapped
    try:
        return isinstance(inner, SubprocVecEnv) and any(remote.poll() for remote in inner.remotes)
    except OSError:  # the pipe is broken or closed
        return True


def step(env: VecEnv, actions: Any) -> tuple[Any, Any, Any, Any]:
    """As ``env.step``, for environments of which a process may end.

    Raises:
        RuntimeError: a process has ended.
    """
    inner = env.unwrapped
    if not isinstance(inner, SubprocVecEnv):
        return env.step(actions)
    with naming_ended_processes(env):
        env.step_async(actions)
        # Forked processes hold each other's pipes open, so that reading from one that has ended could wait for ever.
        for remote, process in zip(inner.remotes, inner.processes, strict=True):
            while not remote.poll(LOOK_EVERY):
                if not process.is_alive():
                    raise EOFError(f"The process {process.name} has ended without an answer.")
        return env.step_wait()


def own_reward(env: VecEnv) -> tuple[Any, str]:
    """The ``reward_fn`` of the first environment or None, and what to say where it is None."""
    missing = "The environment has no reward_fn"
    alone = not isinstance(env.unwrapped, SubprocVecEnv)
    try:
        if not alone and not env.env_method("has_wrapper_attr", "reward_fn", indices=0)[0]:
            return None, missing
        if alone or env.env_method("has_wrapper_attr", _IfPicklable("reward_fn"), indices=0)[0]:
            return env.get_attr("reward_fn", indices=0)[0], missing
    except Exception as error:  # it has none, cannot be unpickled here, or the process has ended, which ``learn`` will tell
        if alone and isinstance(error, AttributeError):
            return None, missing
        if alone:  # an error of its own
            return None, f"The environment's reward_fn cannot be read ({type(error).__name__}: {error})"
    return None, (
        "The environment's reward_fn cannot be pickled, as it must be to leave the environment's process (to plan with it, give "
        "the agent the function: reward=fn)"
    )


class _IfPicklable:
    """The name of an attribute; the environment's process receives an empty one if the attribute's value cannot be pickled."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return _if_picklable, (self._name,)


def _if_picklable(name: str) -> str:
    # SB3's worker has no command that would tell. It unpickles a command's arguments in the function whose ``env`` is asked for.
    frame = sys._getframe()
    while frame.f_back is not None and not isinstance(frame.f_locals.get("env"), gym.Env):
        frame = frame.f_back
    try:
        ForkingPickler.dumps(frame.f_locals["env"].get_wrapper_attr(name))
    except Exception:
        return ""
    return name
