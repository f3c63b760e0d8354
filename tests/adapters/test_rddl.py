"""RDDL domains as Gymnasium environments; skipped where the extra "rddl" is missing."""

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from mbagent.adapters.rddl import RddlEnv, rddl_factory

pytest.importorskip("pyRDDLGym")
pytest.importorskip("rddlrepository")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # their parser's


def played(env: RddlEnv, seed: int, n_steps: int = 60) -> list[Any]:
    """Observations and rewards of random play over more than one episode."""
    rng, seen = np.random.default_rng(0), []
    obs, _ = env.reset(seed=seed)
    for _ in range(n_steps):
        obs, reward, terminated, truncated, _ = env.step(rng.integers(len(env.assignments)))
        seen.append((obs.tolist(), reward, terminated, truncated))
        if terminated or truncated:
            obs, _ = env.reset()
    return seen


@pytest.mark.filterwarnings("ignore:.*render")
def test_a_domain_passes_the_checks_of_gymnasium_and_sb3() -> None:
    env = RddlEnv("SysAdmin_MDP_ippc2011", 1)
    assert env.observation_space == spaces.MultiBinary(10)
    assert env.action_space == spaces.Discrete(11)
    check_env(env, skip_render_check=True)
    sb3_check_env(env)


def test_the_same_seed_gives_the_same_episodes_also_after_pickling() -> None:
    env = RddlEnv("SysAdmin_MDP_ippc2011", 1)
    first = played(env, 3)
    assert played(pickle.loads(pickle.dumps(env)), 3) == first
    assert played(pickle.loads(pickle.dumps(rddl_factory("SysAdmin_MDP_ippc2011")))(), 3) == first
    assert played(env, 4) != first
    assert first[39][3]  # the horizon truncates
    assert not any(truncated for *_, truncated in first[:39])


def test_copies_without_a_seed_do_not_share_their_luck() -> None:
    one, other = (RddlEnv("GameOfLife_MDP_ippc2011", 1) for _ in range(2))
    for env in (one, other):
        env.reset()
    assert [one.step(0)[0].tolist() for _ in range(10)] != [other.step(0)[0].tolist() for _ in range(10)]


def test_actions_are_all_that_may_be_done_at_once() -> None:
    one_at_once = RddlEnv("SysAdmin_MDP_ippc2011", 1).assignments
    assert one_at_once[0] == {}
    assert {name for action in one_at_once[1:] for name in action} == {f"reboot___c{i}" for i in range(1, 11)}
    several = RddlEnv("Traffic_MDP_ippc2014", 1)
    assert max(map(len, several.assignments)) == several.rddl.max_allowed_actions == 4
    assert several.action_space == spaces.Discrete(16)
    several.reset(seed=0)
    several.step(15)  # pyRDDLGym raises where too many are done


def test_fluents_of_more_values_are_numbers() -> None:
    env = RddlEnv("ComplexSysAdmin_rddlsim", 0)
    assert env.observation_space == spaces.MultiDiscrete([3, 2, 2, 2, 2, 2, 2, 2, 2])
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)


def test_what_is_not_seen_at_first_is_shown_as_nothing() -> None:
    env = RddlEnv("CrossingTraffic_POMDP_ippc2011", 1)
    obs, _ = env.reset(seed=0)
    assert not obs.any()
    assert env.observation_space.contains(env.step(0)[0])


@pytest.mark.parametrize(
    ("domain", "instance", "error", "message"),
    [
        ("SysAdmin", 1, ValueError, "no RDDL domain 'SysAdmin'"),
        ("SysAdmin_MDP_ippc2011", 99, ValueError, "no instance 99"),
        ("HVAC", 0, TypeError, "continuous"),
        ("AcademicAdvising_ippc2018", 1, ValueError, "32,768 joint actions"),
    ],
)
def test_what_cannot_be_taken_is_refused_with_the_reason(
    domain: str, instance: int, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        RddlEnv(domain, instance)
