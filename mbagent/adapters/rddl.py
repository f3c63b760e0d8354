"""RDDL domains as environments with a Discrete action space and discrete observations (``pip install "mbagent[rddl]"``).

RDDL (Sanner, Relational Dynamic Influence Diagram Language, 2010) is the language of the probabilistic planning
competitions; ``rddlrepository`` holds their domains, and pyRDDLGym simulates them.
"""

from __future__ import annotations

import importlib.util
import io
import math
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr
from functools import partial
from itertools import combinations, product
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from mbagent.spaces import MAX_ACTIONS

Assignment = dict[str, Any]
"""Values of action fluents that differ from their defaults, by name; {} is the no-op."""


class RddlEnv(gym.Env[NDArray[np.integer[Any]], np.int64], gym.utils.EzPickle):
    """An instance of an RDDL domain, with a Discrete action space and a vector of fluents as the observation.

    Observations have one variable for each state fluent (in a POMDP, each observation fluent): ``MultiBinary`` if all have two
    values, else ``MultiDiscrete``. Joint actions are numbered by how many action fluents differ from their defaults: 0 is the
    no-op, then come all actions with one such fluent, then two, and so on, up to the instance's max-nondef-actions. Episodes are
    truncated at the instance's horizon. Environments can be pickled; each copy has its own random numbers.

    Args:
        domain: a name in rddlrepository ("SysAdmin_MDP_ippc2011"), or the path of a domain.rddl.
        instance: name of one of the domain's instances (1), or the path of an instance.rddl.

    Attributes:
        assignments: the non-default fluent values of each action.
        fluents: name of each variable of an observation.

    Raises:
        DependencyNotInstalled: pyRDDLGym or rddlrepository is missing.
        TypeError: a fluent is continuous.
        ValueError: there is no such domain or instance, or it has more than ``MAX_ACTIONS`` joint actions.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own form

    def __init__(self, domain: str, instance: str | int = 1) -> None:
        """See the class."""
        gym.utils.EzPickle.__init__(self, domain, instance)
        self.domain, self.instance = domain, instance
        self.rddl = load_rddl(domain, instance)
        ranges = {name: _values_of(part, name) for name, part in self.rddl.observation_space.spaces.items()}
        self.fluents = tuple(ranges)
        self._lows = np.array([low for low, _ in ranges.values()], dtype=np.int64)
        sizes = np.array([n for _, n in ranges.values()], dtype=np.int64)
        self.observation_space = spaces.MultiBinary(len(sizes)) if (sizes == 2).all() else spaces.MultiDiscrete(sizes)
        self.assignments = _joint_actions(self.rddl)
        self.action_space = spaces.Discrete(len(self.assignments))
        self.rddl.seed(int(np.random.SeedSequence().generate_state(1)[0]))  # unseeded copies would share one generator

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.integer[Any]], dict[str, Any]]:
        """See gymnasium.Env."""
        super().reset(seed=seed)
        if seed is not None:
            self.rddl.seed(int(self.np_random.integers(2**31)))
        observation, info = self.rddl.reset()
        return self._observed(observation), dict(info)

    def step(self, action: Any) -> tuple[NDArray[np.integer[Any]], float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        observation, reward, terminated, truncated, info = self.rddl.step(self.assignments[int(action)])
        return self._observed(observation), float(reward), bool(terminated), bool(truncated), dict(info)

    def close(self) -> None:
        """See gymnasium.Env."""
        self.rddl.close()

    def _observed(self, fluents: Mapping[str, Any]) -> NDArray[np.integer[Any]]:
        values = [self._number(fluents[name]) for name in self.fluents]  # in a POMDP there is no observation after reset
        numbers = np.maximum(np.array(values, dtype=np.int64) - self._lows, 0)
        observed: NDArray[np.integer[Any]] = numbers.astype(self.observation_space.dtype)
        return observed

    def _number(self, value: Any) -> int:
        """A fluent's value as an integer: for an object, its index within its type; 0 if there is no value."""
        if value is None:
            return 0
        return int(self.rddl.model.object_to_index[value]) if isinstance(value, str) else int(value)


def rddl_factory(domain: str, instance: str | int = 1) -> Callable[[], RddlEnv]:
    """A picklable function without arguments that creates environments, for SubprocVecEnv. See RddlEnv."""
    return partial(RddlEnv, domain, instance)


def load_rddl(domain: str, instance: str | int, **kwargs: Any) -> Any:
    """A pyRDDLGym environment; see RddlEnv for the arguments and errors, and ``pyRDDLGym.RDDLEnv`` for ``**kwargs``."""
    missing = [name for name in ("pyRDDLGym", "rddlrepository") if importlib.util.find_spec(name) is None]
    if missing:
        raise DependencyNotInstalled(f'RDDL domains need {" and ".join(missing)}: pip install "mbagent[rddl]".')
    import pyRDDLGym  # noqa: PLC0415 - an optional dependency
    from rddlrepository import RDDLRepoManager  # noqa: PLC0415
    from rddlrepository.core.error import RDDLRepoDomainNotExistError, RDDLRepoInstanceNotExistError  # noqa: PLC0415

    try:
        with redirect_stderr(io.StringIO()):  # the parser generator reports about its tables
            return pyRDDLGym.make(domain, str(instance), **kwargs)
    except RDDLRepoDomainNotExistError as error:
        some = ", ".join(sorted(RDDLRepoManager().list_problems())[:5])
        raise ValueError(
            f"There is no RDDL domain {domain!r}; rddlrepository has {some} and others (list_problems())."
        ) from error
    except RDDLRepoInstanceNotExistError as error:
        raise ValueError(f"The RDDL domain {domain!r} has no instance {instance!r}.") from error


def _values_of(space: spaces.Space[Any], name: str) -> tuple[int, int]:
    """A fluent's lowest value and number of values."""
    if not isinstance(space, spaces.Discrete):
        raise TypeError(f"The fluent {name!r} is continuous ({space}), and only discrete ones can be modelled.")
    return int(space.start), int(space.n)


def _joint_actions(env: Any) -> tuple[Assignment, ...]:
    """All joint actions with at most the allowed number of non-default fluents, in increasing order of that number."""
    defaults: dict[str, Any] = env._noop_actions  # pyRDDLGym has no public name for them
    choices: dict[str, list[Any]] = {}
    for name, part in env.action_space.spaces.items():
        low, n = _values_of(part, name)
        default = defaults[name]
        default = env.model.object_to_index[default] if isinstance(default, str) else int(default)
        choices[name] = [value for value in range(low, low + n) if value != default]
    most = int(min(env.max_allowed_actions, len(choices)))
    _refuse_too_many([len(values) for values in choices.values()], most)
    return tuple(
        dict(zip(names, values, strict=True))
        for k in range(most + 1)
        for names in combinations(choices, k)
        for values in product(*(choices[name] for name in names))
    )


def _refuse_too_many(sizes: list[int], most: int) -> None:
    """Raises ValueError if there are too many joint actions; counts them without enumerating them."""
    counts = [1] + [0] * most  # by the number of non-default fluents
    for size in sizes:
        counts = [n + size * (counts[k - 1] if k else 0) for k, n in enumerate(counts)]
    if sum(counts) > MAX_ACTIONS:
        many = f"{sum(counts):,}" if sum(counts) < 10**12 else f"about 10^{int(math.log10(sum(counts)))}"
        raise ValueError(
            f"This RDDL instance has {many} joint actions, more than the {MAX_ACTIONS:,} that planning can enumerate; "
            "choose an instance with fewer action fluents or a lower max-nondef-actions."
        )
