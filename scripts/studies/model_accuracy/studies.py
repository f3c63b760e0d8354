"""Further studies of models: changes of rules, transfer, cost, dependencies, and error estimates.

Each study is a function of (seed, full) that returns rows: dictionaries with the same keys.
"""

from __future__ import annotations

import importlib.util
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import MultiBinary
from scipy.stats import rankdata, spearmanr
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from harness import Result, Row, check_known
from mbagent.agent import ModelLearningAgent
from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel
from mbagent.models.dbn.model import parent_factors, tested_features
from mbagent.models.model_error import estimate_error, likeliest, missed
from mbagent.models.protocol import TransitionModel
from mbagent.models.registry import build_model
from mbagent.models.simulator import SimulatorModel
from mbagent.spaces import FactoredSpace
from mbagent.types import Bools, Floats, Ints
from mbagent_envs import Game, Maneuverer
from mbagent_envs.random_keys import derive
from studies.model_accuracy.experiment import CASES, LEARNING_RATE, certain_factors, random_play
from worlds.games import find_case
from worlds.known_rules import scale_of
from worlds.minatar import minatar, variants
from worlds.nonstationary import CHANGES

NAN = float("nan")
N_TESTS = 20_000


def learned(space: FactoredSpace, n_actions: int, *parts: TransitionBatch, name: str = "auto") -> TransitionModel:
    """A model fitted to consecutive parts of transitions."""
    data = TransitionDataset(space.cardinalities, n_actions)
    for number, part in enumerate(parts):
        shifted = TransitionBatch(
            part.states, part.actions, part.next_states, part.terminated, part.rewards, part.episodes + 100_000 * number
        )
        data.append(shifted)
    model = build_model(name, space, n_actions, LEARNING_RATE)
    model.fit(data, seed=0)
    return model


def exact(model: TransitionModel, tests: TransitionBatch, certain: Bools) -> float:
    """Share of the included transitions whose certain factors are all predicted correctly."""
    judged = certain.any(axis=1)
    found, _ = likeliest(model, tests.states, tests.actions)
    return float(((found == tests.next_states) | ~certain).all(axis=1)[judged].mean())


def changes(seed: int, full: bool) -> list[Row]:
    """The rules change after 10,000 steps: exactness after further steps, compared with learning from these alone."""
    rows = []
    for name, make in CHANGES.items():
        before, after = make()
        space = FactoredSpace(before.observation_space)
        n_actions, order = int(before.action_space.n), np.arange(len(space))
        old = random_play(before, 10_000, seed, order)
        tests = random_play(after, N_TESTS, seed + 10_000, order)
        certain = certain_factors(SimulatorModel(after), tests, order, seed)
        for steps in (50, 100, 200, 300, 500, 700, 1000) if full else (100, 200, 300, 500):
            new = random_play(after, steps, seed + 1, order)
            continued, fresh = learned(space, n_actions, old, new), learned(space, n_actions, new)
            figures = {"continued": exact(continued, tests, certain), "from scratch": exact(fresh, tests, certain)}
            rows.append({"change": name, "steps after it": steps, **figures})
    return rows


def alarms(seed: int, full: bool) -> list[Row]:
    """False alarms: variables with detected change points in worlds whose rules never change."""
    rows = []
    for case in CASES:
        game = case.game()
        space, n_actions = FactoredSpace(game.observation_space), int(game.action_space.n)
        order = np.arange(len(space))
        if case.flat:
            order, space = np.random.default_rng(seed).permutation(len(space)), FactoredSpace(MultiBinary(len(space)))
        for steps in (1000, 2000, 5000, 10_000, 20_000) if full else (1000, 5000):
            data = TransitionDataset(space.cardinalities, n_actions)
            data.append(random_play(game, steps, seed, order))
            report = build_model("auto", space, n_actions, LEARNING_RATE).fit(data, seed=0)
            rows.append({"world": case.name, "steps": steps, "taken for changed": report.log["changed"]})
    return rows


def transfer(seed: int, full: bool) -> list[Row]:
    """Maneuverer learned on size 6 and used on other sizes without further learning."""
    game = Maneuverer(size=6)
    space = FactoredSpace(game.observation_space)
    model = learned(space, 4, random_play(game, 20_000, seed, np.arange(len(space))))
    assert isinstance(model, LocalGraphModel)
    rows = []
    for size in (6, 8, 10, 14) if full else (6, 10):
        other = Maneuverer(size=size)
        wider = FactoredSpace(other.observation_space)
        order = np.arange(len(wider))
        tests = random_play(other, N_TESTS, seed + 10_000, order)
        certain = certain_factors(SimulatorModel(other), tests, order, seed)
        large, judged = model.for_space(wider), certain.any(axis=1)
        drawn, _ = large.sample(tests.states, tests.actions, derive(1, np.arange(len(tests))))
        hit = ((drawn == tests.next_states) | ~certain).all(axis=1)[judged].mean()
        rows.append({"size": size, "likeliest": exact(large, tests, certain), "sampled": float(hit)})
    return rows


def cost(seed: int, full: bool) -> list[Row]:
    """Time of the fit and of one sampled state, on Maneuverer's planes, against the number of variables d."""
    rows = []
    for size in (4, 6, 9, 12, 16, 24) if full else (4, 8, 16):
        game = Maneuverer(size=size)
        space = FactoredSpace(game.observation_space)
        data = TransitionDataset(space.cardinalities, 4)
        data.append(random_play(game, 5000, seed, np.arange(len(space))))
        model = build_model("auto", space, 4, LEARNING_RATE)
        model.fit(data, seed=0)  # compiles
        seconds, each = [], []
        some = data.rows().select(np.arange(2000))
        for _ in range(3):
            began = time.process_time()
            model.fit(data, seed=0)
            seconds.append(time.process_time() - began)
            began = time.process_time()
            model.sample(some.states, some.actions, derive(1, np.arange(len(some))))
            each.append(1e6 * (time.process_time() - began) / len(some))
        figures = {"fit seconds": float(np.median(seconds)), "sample microseconds": float(np.median(each))}
        rows.append({"d": len(space), "size": size, **figures})
    return rows


def parents(seed: int, full: bool) -> list[Row]:
    """Learned dependencies between variables, compared with true ones found by changing one variable at a time."""
    rows = []
    for case in CASES:
        if not case.flat:
            continue
        game, steps = case.game(), 20_000 if full else 5000
        space = FactoredSpace(game.observation_space)
        flat = FactoredSpace(MultiBinary(len(space)))
        model = learned(flat, int(game.action_space.n), random_play(game, steps, seed, np.arange(len(space))))
        assert isinstance(model, DecisionGraphModel)
        layout = model.fitted.layout
        groups = [layout.members[a:b] for a, b in itertools.pairwise(layout.first[:-2])]
        true, found = true_parents(game, groups, seed), np.zeros((len(groups), len(groups)), dtype=np.bool_)
        for v in range(len(groups)):
            tested = parent_factors(layout, tested_features(model.fitted.usual, v))
            found[v] = [bool(tested & set(members.tolist())) for members in groups]
        np.fill_diagonal(found, False)
        hits = int((found & true).sum())
        shares = {"precision": hits / found.sum() if found.any() else NAN, "recall": hits / true.sum() if true.any() else NAN}
        rows.append({"world": case.name, "steps": steps, "true": int(true.sum()), "found": int(found.sum()), **shares})
    return rows


def true_parents(game: Game, groups: Sequence[Ints], seed: int, n: int = 3000) -> Bools:
    """True dependencies between variables, bool [U, U], found by changing one at a time in states of random play.

    Bits are flipped, mutex groups get another bit, with the same random numbers before and after. Steps that redraw almost all
    variables, and changes that give no valid state of the game, are ignored.
    """
    true, rng = SimulatorModel(game), np.random.default_rng(seed)
    size, shape = len(true.cardinalities), game.observation_space.shape
    rows, keys = random_play(game, n, seed + 7, np.arange(size)), derive(seed, np.arange(n))
    normal, _ = true.sample(rows.states, rows.actions, keys)
    counts = (normal != rows.states).sum(axis=1)
    most = 2.0 * max(1.0, float(np.quantile(counts, 0.95)))
    found = np.zeros((len(groups), len(groups)), dtype=np.bool_)
    for u, members in enumerate(groups):
        changed = rows.states.copy()
        if len(members) == 1:
            changed[:, members[0]] ^= 1
        else:
            changed[:, members] = np.eye(len(members), dtype=np.int64)[rng.integers(len(members), size=n)]
        valid = [game.invalid(state.reshape(1, *shape).astype(np.int8)) is None for state in changed]
        other, _ = true.sample(changed, rows.actions, keys)
        few = (counts <= most) & ((other != changed).sum(axis=1) <= most)
        differs = (normal != other)[few & valid].sum(axis=0) > 2
        found[:, u] = [bool(differs[own].any()) for own in groups]
    np.fill_diagonal(found, False)
    return found


def trust(seed: int, full: bool) -> list[Row]:
    """Estimated probabilities of a wrong prediction against observed frequencies, in bins."""
    rows = []
    chosen = (("Maneuverer, flat", 2000), ("two players, flat", 5000), ("pushed box, flat", 5000), ("switch, flat", 5000))
    for name, steps in chosen if full else chosen[:2]:
        game = next(case for case in CASES if case.name == name).game()
        space = FactoredSpace(MultiBinary(len(FactoredSpace(game.observation_space))))
        order, n_actions = np.arange(len(space)), int(game.action_space.n)
        data = TransitionDataset(space.cardinalities, n_actions)
        data.append(random_play(game, steps, seed, order))
        model = build_model("auto", space, n_actions, LEARNING_RATE)
        model.fit(data, seed=0)
        error = estimate_error(partial(build_model, "auto", space, n_actions, LEARNING_RATE), model, data, seed=seed)
        tests = random_play(game, N_TESTS, seed + 10_000, order)
        estimated, wrong = error(tests.states, tests.actions), missed(model, tests)
        label: Row = {"world": name, "steps": steps}
        ranks = {"area under curve": area(estimated, wrong), "rank correlation": NAN}
        if wrong.any():
            ranks["rank correlation"] = float(spearmanr(estimated, wrong).statistic)
        edges = np.array([0.0, 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0 + 1e-9])
        bins = [("all", np.ones(len(wrong), dtype=np.bool_))]
        bins += [(f"from {low:g}", (estimated >= low) & (estimated < high)) for low, high in itertools.pairwise(edges)]
        for part, inside in bins:
            if inside.sum() >= 20:
                means = {"estimate": float(estimated[inside].mean()), "rate": float(wrong[inside].mean())}
                whole = ranks if part == "all" else dict.fromkeys(ranks, NAN)
                rows.append({**label, "bin": part, "in bin": int(inside.sum()), **means, **whole})
    return rows


def area(scores: Floats, positive: Bools) -> float:
    """Probability that a positive case scores higher than a negative one (area under the ROC curve); NaN for one class only."""
    n = int(positive.sum())
    if n in (0, len(positive)):
        return NAN
    ranks = rankdata(scores)[positive].sum()
    return float((ranks - n * (n + 1) / 2) / (n * (len(positive) - n)))


def agents(seed: int, full: bool) -> list[Row]:
    """Maneuverer after 5,000 steps of random play, compared with the same planner on the true model; cost compared with PPO."""
    env = gym.make("mbagent/Maneuverer-v0")
    game = Maneuverer()
    episodes = 40 if full else 4

    def played(agent: Any) -> float:
        many = make_vec_env("mbagent/Maneuverer-v0", n_envs=4, seed=seed + 5000)
        return float(np.mean(evaluate_policy(agent, many, n_eval_episodes=episodes)[0]))

    learner = ModelLearningAgent("MctsPolicy", env, seed=seed).learn(5000, log_interval=None)
    true = ModelLearningAgent("MctsPolicy", gym.make("mbagent/Maneuverer-v0"), model=SimulatorModel(game), seed=seed)
    returns = {"learned": played(learner), "true": played(true)}
    began = time.process_time()
    ModelLearningAgent("MctsPolicy", gym.make("mbagent/Maneuverer-v0"), seed=seed).learn(20_000, log_interval=None)
    ours, began = time.process_time() - began, time.process_time()
    PPO("MlpPolicy", gym.make("mbagent/Maneuverer-v0"), seed=seed, device="cpu").learn(100_000)
    seconds = {"20,000 steps, s": ours, "PPO 100,000 steps, s": time.process_time() - began}
    scale = scale_of(find_case("maneuverer").world)
    gap = (returns["learned"] - returns["true"]) / (scale.reference - scale.random)
    return [{"game": "Maneuverer", **returns, "learned - true, normalised": gap, **seconds}]


Study: TypeAlias = Callable[[int, bool], list[Row]]

STUDIES: dict[str, Study] = {
    "changes": changes,
    "alarms": alarms,
    "transfer": transfer,
    "cost": cost,
    "parents": parents,
    "trust": trust,
    "agents": agents,
    "minatar": minatar,
}


@dataclass(frozen=True)
class Question:
    """One study, or a part of it, with one seed."""

    study: str
    work: Study
    seed: int
    full: bool


def questions(names: Sequence[str], seeds: Sequence[int], full: bool) -> list[Question]:
    """All parts of the given studies with all seeds.

    Raises:
        ValueError: a study is unknown, or its packages are missing.
    """
    check_known("study", names, STUDIES)
    if "minatar" in names and importlib.util.find_spec("minatar") is None:
        raise ValueError('The study minatar needs MinAtar: pip install "mbagent[minatar]".')
    return [Question(name, work, seed, full) for name in names for seed in seeds for work in parts(name, full)]


def answer(question: Question) -> Result[Question]:
    """Runs a study."""
    torch.set_num_threads(1)
    rows = question.work(question.seed, question.full)
    return Result(question, {question.study: rows}, f"{question.study}, seed {question.seed}")


def parts(study: str, full: bool) -> list[Study]:
    """The parts of a study, which are run and saved separately."""
    return [partial(minatar, variant=each) for each in variants(full)] if study == "minatar" else [STUDIES[study]]
