"""mbagent: an agent that learns a model of a stochastic discrete environment and can then plan for any reward function.

Importing this package registers the games ``mbagent/GeyserRunner-v0``, ``mbagent/Maneuverer-v0`` and
``mbagent/FlierCatcher-v0`` with Gymnasium.
"""

import gc

_collecting = gc.isenabled()
gc.disable()  # collecting takes a fifth of the time of these imports, and they leave no garbage
try:
    import mbagent_envs
    from mbagent import moved, wrappers
    from mbagent.agent import ModelLearningAgent
    from mbagent.data import TransitionBatch, TransitionDataset
    from mbagent.explain import Explanation, Future, Step
    from mbagent.learned_env import LearnedEnv
    from mbagent.planning.planner import PlannerSettings
    from mbagent.policies import FlatMonteCarloPolicy, MctsPolicy, PlannerPolicy, ValueIterationPolicy
    from mbagent.rewards import RewardFn
    from mbagent.spaces import ActionEnumeration, FactoredSpace
finally:
    if _collecting:
        gc.enable()

__version__ = "0.1.0"

moved.install()

__all__ = [
    "ActionEnumeration",
    "Explanation",
    "FactoredSpace",
    "FlatMonteCarloPolicy",
    "Future",
    "LearnedEnv",
    "MctsPolicy",
    "ModelLearningAgent",
    "PlannerPolicy",
    "PlannerSettings",
    "RewardFn",
    "Step",
    "TransitionBatch",
    "TransitionDataset",
    "ValueIterationPolicy",
    "mbagent_envs",
    "wrappers",
]
