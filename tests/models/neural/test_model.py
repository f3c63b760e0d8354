from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from mbagent.data import TransitionDataset
from mbagent.models import DensePredictor, FactorCodec, NeuralConfig, NeuralTransitionModel, TrainingConfig
from mbagent.models.neural.networks import Mask
from mbagent_envs.geyser_runner import GeyserRunner
from mbagent_envs.random_keys import derive, uniforms
from tests.models.helpers import MIXED, QUICK, dataset, distribution, outcome_numbers, outcomes, played, random_rows, scrambled

Ints = np.ndarray


class TorchBody(torch.nn.Module):
    """A body without a compiled kernel."""

    def __init__(self, codec: FactorCodec, generator: torch.Generator) -> None:
        super().__init__()
        self.inner = DensePredictor(codec, (16,), generator=generator)

    def forward(self, states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        logits: torch.Tensor = self.inner(states, actions)
        return logits


def paper_world(pairs: list[tuple[int, int]], n: int = 1200, seed: int = 0) -> TransitionDataset:
    """Section 3.2's examples: two variables, and the two next states ``pairs`` with equal probability."""
    following = np.asarray(pairs)[np.random.default_rng(seed).integers(len(pairs), size=n)]
    return dataset((2, 2), 1, np.zeros((n, 2), dtype=np.int64), np.zeros(n, dtype=np.int64), following)


def mixed_world(n: int, seed: int = 0) -> tuple[TransitionDataset, Callable[[Ints, int], Ints]]:
    """Next states that depend on each other, the action and the state, over factors of all sizes."""

    def possible(state: Ints, action: int) -> Ints:
        """The three equally likely outcomes; the last column is terminated."""
        k = np.arange(3)
        third = (state[1] + action + k) % 3
        return np.stack([third % 2, third, np.full(3, state[0]), (state[3] + third) % 4, third == 2], axis=1)

    states, actions = random_rows(MIXED, 2, n, seed)
    noise = np.random.default_rng(seed + 1).integers(3, size=n)
    following = np.stack([possible(s, a)[u] for s, a, u in zip(states, actions, noise, strict=True)])
    return dataset(MIXED, 2, states, actions, following[:, :-1], following[:, -1] == 1), possible


@pytest.mark.parametrize("pairs", [[(0, 0), (1, 1)], [(1, 0), (0, 1)]])
@pytest.mark.parametrize("mask", ["causal", "others"])
def test_with_a_conditioner_only_reachable_states_are_sampled(pairs: list[tuple[int, int]], mask: Mask) -> None:
    data, n = paper_world(pairs), 2000
    where = (np.zeros((n, 2), dtype=np.int64), np.zeros(n, dtype=np.int64))
    model = NeuralTransitionModel((2, 2), 1, NeuralConfig(conditioner=mask, training=QUICK))
    model.fit(data)
    sampled, ends = model.sample(*where, np.random.default_rng(0))
    counts = np.bincount(outcome_numbers((2, 2), sampled, ends), minlength=8) / n
    valid = outcome_numbers((2, 2), np.asarray(pairs), np.zeros(2, dtype=np.bool_))
    assert counts[valid].sum() > 0.99
    assert counts[valid] == pytest.approx([0.5, 0.5], abs=0.06)


def test_the_predictor_alone_also_samples_unreachable_states() -> None:
    n, model = 4000, NeuralTransitionModel((2, 2), 1, NeuralConfig(conditioner=None, training=QUICK))
    model.fit(paper_world([(1, 0), (0, 1)]))
    where = (np.zeros((n, 2), dtype=np.int64), np.zeros(n, dtype=np.int64))
    numbers = outcome_numbers((2, 2), *model.sample(*where, np.random.default_rng(0)))
    assert np.bincount(numbers, minlength=8)[[0, 2, 4, 6]] / n == pytest.approx([0.25] * 4, abs=0.05)


@pytest.mark.parametrize("config", [NeuralConfig(), NeuralConfig(conditioner=None), NeuralConfig(certain=0.7)])
def test_probabilities_of_all_outcomes_sum_to_one_and_are_what_is_sampled(config: NeuralConfig) -> None:
    model, n = scrambled(config=config), 60_000
    for state, action in zip(*random_rows(MIXED, 3, 3), strict=True):
        exact = distribution(model, state, int(action))
        assert exact.sum() == pytest.approx(1.0, abs=1e-9)
        drawn = model.sample(np.tile(state, (n, 1)), np.full(n, action), np.random.default_rng(1))
        shares = np.bincount(outcome_numbers(MIXED, *drawn), minlength=len(exact)) / n
        assert np.abs(shares - exact).sum() < 2.5 * np.sqrt(exact / n).sum()


@pytest.mark.parametrize("config", [NeuralConfig(), NeuralConfig(conditioner=None), NeuralConfig(conditioner="others")])
@pytest.mark.parametrize("body", [None, TorchBody])
def test_a_row_is_bitwise_the_same_alone_and_in_any_batch(
    config: NeuralConfig, body: Callable[..., torch.nn.Module] | None
) -> None:
    cardinalities, n = (*MIXED, 5, 2, 2, 2), 150
    model = scrambled(cardinalities, 3, config, scale=0.5, body=body)
    states, actions = random_rows(cardinalities, 3, n)
    keys = derive(np.arange(n), 7)
    marginals, (following, ends) = model.marginals(states, actions), model.sample(states, actions, keys)
    found = model.successors(states, actions, 8, seed=3)
    exact = config.conditioner != "others"
    logs = model.log_prob(states, actions, following, ends) if exact else np.zeros(n)
    for part in (slice(0, 1), slice(77, 78), slice(n - 1, n), slice(13, 95)):
        rows = states[part], actions[part]
        assert np.array_equal(model.marginals(*rows), marginals[part])
        again, again_ends = model.sample(*rows, keys[part])
        assert np.array_equal(again, following[part])
        assert np.array_equal(again_ends, ends[part])
        if exact:
            assert np.array_equal(model.log_prob(*rows, again, again_ends), logs[part])
        few, span = model.successors(*rows, 8, seed=3), slice(*found.offsets[[part.start, part.stop]])
        assert np.array_equal(few.states, found.states[span])
        assert np.array_equal(few.terminated, found.terminated[span])
        assert np.array_equal(few.probabilities, found.probabilities[span])


def test_factors_of_all_sizes_are_learned_with_their_dependencies_and_termination() -> None:
    data, possible = mixed_world(6000)
    model = NeuralTransitionModel(MIXED, 2, NeuralConfig(training=TrainingConfig(min_steps=700, max_steps=700)))
    report = model.fit(data)
    errors = []
    for state, action in zip(*random_rows(MIXED, 2, 40, seed=5), strict=True):
        expected = np.zeros(2 * np.prod(MIXED))
        following = possible(state, int(action))
        expected[outcome_numbers(MIXED, following[:, :-1], following[:, -1] == 1)] = 1 / 3
        errors.append(0.5 * np.abs(distribution(model, state, int(action)) - expected).sum())
    assert np.mean(errors) < 0.08
    assert report.predictor_loss is not None
    assert report.conditioner_loss is not None
    assert report.conditioner_loss == pytest.approx(np.log(3), abs=0.1)
    assert report.predictor_loss > 2 * report.conditioner_loss


def test_a_stochastic_game_is_learned_to_near_its_true_distribution() -> None:
    game = GeyserRunner(mode="stochastic", width=6)
    model = NeuralTransitionModel((2,) * 9, 3, NeuralConfig(training=TrainingConfig(min_steps=700, max_steps=700)))
    model.fit(played(game, 20_000, 100))
    errors, invalid = [], []
    for position, eruption, action in np.ndindex(6, 3, 3):
        state = np.zeros(9, dtype=np.int64)
        state[position] = state[6 + eruption] = 1
        following, weights = game.transition_distribution(state.astype(np.int8), action)
        exact = np.zeros(2**10)
        exact[outcome_numbers((2,) * 9, following.astype(np.int64), np.zeros(len(following), dtype=np.bool_))] = weights
        learned = distribution(model, state, action)
        errors.append(0.5 * np.abs(learned - exact).sum())
        invalid.append(learned[exact == 0].sum())
    assert np.mean(errors) < 0.04
    assert max(invalid) < 0.02


@pytest.mark.parametrize("config", [NeuralConfig(training=QUICK), NeuralConfig(conditioner="others", training=QUICK)])
def test_weights_survive_a_round_trip_as_plain_arrays(config: NeuralConfig) -> None:
    data, _ = mixed_world(500)
    model = NeuralTransitionModel(MIXED, 2, config)
    model.fit(data)
    state = model.state_dict()
    assert all(array.dtype in (np.float32, np.bool_) for array in state.values())
    other = NeuralTransitionModel(MIXED, 2, config, seed=9)
    other.load_state_dict(state)
    states, actions = random_rows(MIXED, 2, 50)
    keys = derive(np.arange(50), 1)
    assert np.array_equal(model.marginals(states, actions), other.marginals(states, actions))
    for a, b in zip(model.sample(states, actions, keys), other.sample(states, actions, keys), strict=True):
        assert np.array_equal(a, b)
    assert all(np.array_equal(state[name], array) for name, array in other.state_dict().items())


def test_weights_of_another_shape_are_refused_and_change_nothing() -> None:
    model, small = scrambled(), scrambled((2, 2))
    before = model.state_dict()
    with pytest.raises(ValueError, match="do not fit"):
        model.load_state_dict(small.state_dict())
    with pytest.raises(ValueError, match="predictor"):
        model.load_state_dict({k: v for k, v in before.items() if not k.startswith("predictor")})
    assert all(np.array_equal(before[name], array) for name, array in model.state_dict().items())


def test_a_fit_depends_on_its_seed_alone_and_leaves_the_process_wide_generators_alone() -> None:
    data, _ = mixed_world(400)
    training = TrainingConfig(min_steps=60, max_steps=60)

    def weights(seed: int, models_seed: int) -> dict[str, np.ndarray]:
        model = NeuralTransitionModel(MIXED, 2, NeuralConfig(training=training), seed=models_seed)
        model.fit(data, seed=seed)
        model.fit(data, seed=seed)
        return model.state_dict()

    torch.random.manual_seed(0)
    first = weights(5, 0)
    torch.random.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002 (the test is that it has no effect)
    torch_state, numpy_state = torch.random.get_rng_state(), str(np.random.get_state())  # noqa: NPY002
    n_threads = torch.get_num_threads()
    torch.set_num_threads(2)
    second = weights(5, 1)
    assert torch.get_num_threads() == 2
    torch.set_num_threads(n_threads)
    assert torch.equal(torch_state, torch.random.get_rng_state())
    assert numpy_state == str(np.random.get_state())  # noqa: NPY002
    assert all(array.tobytes() == second[name].tobytes() for name, array in first.items())
    third = weights(6, 0)
    assert any(array.tobytes() != third[name].tobytes() for name, array in first.items())


def test_on_line_learning_follows_a_world_that_changes() -> None:
    model = NeuralTransitionModel((2, 2), 1)
    for pairs in ([(0, 0), (1, 1)], [(1, 0), (0, 1)]):
        rows = paper_world(pairs, 4800).rows()
        for start in range(0, 4800, 16):
            part = slice(start, start + 16)
            model.observe(rows.states[part], rows.actions[part], rows.next_states[part], rows.terminated[part])
        valid = outcome_numbers((2, 2), np.asarray(pairs), np.zeros(2, dtype=np.bool_))
        assert distribution(model, np.zeros(2, dtype=np.int64), 0)[valid] == pytest.approx([0.5, 0.5], abs=0.1)


@pytest.mark.parametrize("real_guess", [False, True])
def test_sweeps_reach_the_joint_distribution(real_guess: bool) -> None:
    """Three bits whose possible outcomes are connected by changes of single bits."""
    cardinalities, n = (2, 2, 2), 8000
    joint = np.array([0.3, 0.1, 0.05, 0.05, 0.05, 0.05, 0.1, 0.3])
    drawn = np.random.default_rng(0).choice(8, size=n, p=joint)
    following = np.stack(np.unravel_index(drawn, cardinalities), axis=1)
    data = dataset(cardinalities, 1, np.zeros((n, 3), dtype=np.int64), np.zeros(n, dtype=np.int64), following)
    config = NeuralConfig(conditioner="others", sweeps=12, real_guess=real_guess, training=QUICK)
    model = NeuralTransitionModel(cardinalities, 1, config)
    model.fit(data)
    sampled, ends = model.sample(np.zeros((n, 3), dtype=np.int64), np.zeros(n, dtype=np.int64), np.random.default_rng(1))
    shares = np.bincount(np.ravel_multi_index(tuple(sampled.T), cardinalities), minlength=8) / n
    assert 0.5 * np.abs(shares - joint).sum() < 0.04
    assert ends.mean() < 0.01
    with pytest.raises(NotImplementedError, match="causal"):
        model.log_prob(sampled, np.zeros(n, dtype=np.int64), sampled, ends)


@pytest.mark.parametrize("cardinalities", [(2, 2, 2, 2), MIXED, (2,)])
def test_sweeps_resample_each_factor_given_all_others(cardinalities: tuple[int, ...]) -> None:
    """Against the same draws with the torch networks, one factor at a time."""
    model = scrambled(cardinalities, 3, NeuralConfig(conditioner="others", certain=1.0, sweeps=2, group_size=4))
    assert model.conditioner is not None
    states, actions = random_rows(cardinalities, 3, 60)
    keys, (s, a) = derive(7, np.arange(60)), (torch.from_numpy(states), torch.from_numpy(actions))
    probs, n_outputs = model.probabilities(states, actions), len(cardinalities) + 1
    expected = (uniforms(keys, n_outputs)[:, :, None] >= probs.cumsum(axis=2)[:, :, :-1]).sum(axis=2)
    for sweep in range(2):
        sweep_keys = derive(keys, sweep)
        noise, order = uniforms(sweep_keys, n_outputs), uniforms(derive(sweep_keys, 1 << 32), n_outputs).argsort(axis=1)
        for step in range(n_outputs):
            with torch.no_grad():
                logits = model.predictor(s, a) + model.conditioner(s, a, torch.from_numpy(expected))
            given = torch.softmax(logits.double(), dim=2).numpy().cumsum(axis=2)
            for b, i in enumerate(order[:, step]):
                expected[b, i] = (noise[b, i] >= given[b, i, : (*cardinalities, 2)[i] - 1]).sum()
    sampled, ends = model.sample(states, actions, keys)
    np.testing.assert_array_equal(np.concatenate([sampled, ends[:, None]], axis=1), expected)


def test_the_papers_configuration_learns_its_own_example() -> None:
    config = NeuralConfig.paper(2)
    model = NeuralTransitionModel((2, 2), 1, replace(config, training=replace(config.training, min_steps=700)))
    model.fit(paper_world([(1, 0), (0, 1)]))
    where = (np.zeros((2000, 2), dtype=np.int64), np.zeros(2000, dtype=np.int64))
    sampled, _ = model.sample(*where, np.random.default_rng(0))
    assert (sampled.sum(axis=1) == 1).mean() > 0.97


def test_progress_rises_to_one_and_an_empty_data_set_is_no_accident() -> None:
    shares: list[float] = []
    model = NeuralTransitionModel(MIXED, 2, NeuralConfig(training=TrainingConfig(min_steps=40, max_steps=40, patience=99)))
    model.fit(mixed_world(200)[0], progress=shares.append)
    assert shares[-1] == 1.0
    assert all(a <= b for a, b in pairwise(shares))
    report = model.fit(TransitionDataset(MIXED, 2))
    assert report.n_train == 0
    assert np.isfinite(model.marginals(*random_rows(MIXED, 2, 5))).all()


def test_marginals_are_laid_out_factor_after_factor() -> None:
    model = scrambled(config=NeuralConfig(conditioner=None))
    states, actions = random_rows(MIXED, 3, 4)
    marginals = model.marginals(states, actions)
    following, _ = outcomes(MIXED)
    start = 0
    for factor, cardinality in enumerate(MIXED):
        for row in range(4):
            exact = np.bincount(following[:, factor], weights=distribution(model, states[row], int(actions[row])))
            assert marginals[row, start : start + cardinality] == pytest.approx(exact, abs=1e-9)
        start += cardinality
    assert marginals.shape == (4, start)
