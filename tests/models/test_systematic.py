import numpy as np
import pytest

from mbagent.models import NeuralConfig, NeuralTransitionModel, Successors
from mbagent.models.particles import NEGLIGIBLE, start
from mbagent.models.systematic import ancestral_successors, independent_successors
from mbagent.models.thinning import thin
from tests.models.helpers import MIXED, Floats, Ints, distribution, outcome_numbers, outcomes, random_rows, scrambled

CONFIGS = [NeuralConfig(hidden=(8,), group_size=4, conditioner=mask) for mask in ("causal", None)]


def rows_of(found: Successors, cardinalities: tuple[int, ...] = MIXED) -> list[dict[int, float]]:
    """Each row's outcomes, by number, with their probabilities."""
    numbers = outcome_numbers(cardinalities, found.states, found.terminated)
    spans = zip(found.offsets[:-1], found.offsets[1:], strict=True)
    result = [dict(zip(numbers[a:b].tolist(), found.probabilities[a:b].tolist(), strict=True)) for a, b in spans]
    assert sum(map(len, result)) == len(numbers)  # no outcome twice
    return result


def conditionals(model: NeuralTransitionModel, states: Ints, actions: Ints) -> list[Floats]:
    """P(y_i | y_<i) of each row by brute force: [B, *outputs up to i] for each factor i."""
    outputs = (*model.cardinalities, 2)
    joint = np.stack([distribution(model, s, int(a)).reshape(outputs) for s, a in zip(states, actions, strict=True)])
    result = []
    for i in range(len(outputs)):
        prefix = joint.sum(axis=tuple(range(i + 2, len(outputs) + 1)))
        result.append(prefix / prefix.sum(axis=-1, keepdims=True))
    return result


def pruned_distribution(tables: list[Floats], row: int) -> Floats:
    """The joint distribution after negligible conditional probabilities are dropped."""
    joint: Floats = np.ones(())
    for table in tables:
        p = table[row]
        p = np.where(p < NEGLIGIBLE * p.max(axis=-1, keepdims=True), 0.0, p)
        joint = joint[..., None] * (p / p.sum(axis=-1, keepdims=True))
    return joint.ravel()


@pytest.mark.parametrize("config", CONFIGS)
def test_with_many_points_every_outcome_is_found_with_its_exact_probability(config: NeuralConfig) -> None:
    model = scrambled(config=config)
    states, actions = random_rows(MIXED, 3, 5)
    tables = conditionals(model, states, actions)
    for row, found in enumerate(rows_of(model.successors(states, actions, 100_000, seed=1))):
        exact = pruned_distribution(tables, row)
        assert sum(found.values()) == pytest.approx(1.0, abs=1e-12)
        assert exact[list(found)].sum() > 0.999
        assert found == pytest.approx({k: exact[k] / exact[list(found)].sum() for k in found}, abs=1e-6)


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("n", [1, 5, 16])
def test_with_few_points_likely_outcomes_are_never_missed_and_shares_are_right_on_average(config: NeuralConfig, n: int) -> None:
    model = scrambled(config=config)
    states, actions = random_rows(MIXED, 3, 4)
    tables, total = conditionals(model, states, actions), np.zeros((4, 2 * int(np.prod(MIXED))))
    n_seeds = 600
    for seed in range(n_seeds):
        for row, found in enumerate(rows_of(model.successors(states, actions, n, seed))):
            exact = pruned_distribution(tables, row)
            assert len(found) <= n
            assert sum(found.values()) == pytest.approx(1.0)
            assert set(np.flatnonzero(exact >= 2 / n)) <= set(found)
            if exact[list(found)].sum() >= 0.95:
                assert found == pytest.approx({k: exact[k] / exact[list(found)].sum() for k in found}, abs=1e-5)
            else:
                assert all(weight * n == pytest.approx(round(weight * n)) for weight in found.values())
            total[row, list(found)] += list(found.values())
    for row in range(4):
        assert np.abs(total[row] / n_seeds - pruned_distribution(tables, row)).sum() < 3.0 / np.sqrt(n_seeds * n) * 4


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("n", [1, 7, 64])
def test_compiled_and_general_procedure_find_the_same(config: NeuralConfig, n: int) -> None:
    model = scrambled(config=config)
    states, actions = random_rows(MIXED, 3, 30)
    tables, outputs = conditionals(model, states, actions), np.asarray((*MIXED, 2))

    def conditional(i: int, row: Ints, factors: Ints) -> Floats:
        found: Floats = tables[i][(row, *factors[:, :i].T)]
        return found

    found = rows_of(model.successors(states, actions, n, seed=5))
    general = rows_of(ancestral_successors(30, outputs, conditional, n, seed=5))
    for a, b in zip(found, general, strict=True):
        assert a == pytest.approx(b, abs=1e-5)


def test_many_fair_bits_do_not_run_out_of_precision() -> None:
    n, n_bits = 16, 200
    found = independent_successors(np.full((3, n_bits, 2), 0.5), np.full(n_bits, 2), n, seed=2)
    assert np.array_equal(np.diff(found.offsets), [n] * 3)
    assert found.probabilities == pytest.approx(np.full(3 * n, 1 / n))
    first, second = found.states[:n], found.states[n : 2 * n]
    assert np.array_equal(first, second)  # random numbers shared by all rows
    assert first[:, :4].sum() == n * 4 / 2  # the first log2(n) bits are stratified
    assert first[:, 4:].mean() == pytest.approx(0.5, abs=0.05)  # the rest is fresh luck,
    differing = (first[:, None, 4:] != first[None, :, 4:]).mean(axis=2)[np.triu_indices(n, 1)]
    assert (np.abs(differing - 0.5) < 0.15).all()  # of each point its own


def test_settled_factors_and_tiny_probabilities_cost_nothing() -> None:
    probs = np.tile([0.995, 0.005], (1, 300, 1))
    found = independent_successors(probs, np.full(300, 2), 16, seed=0)
    assert len(found.states) == 1
    assert not found.states.any()
    assert found.probabilities == pytest.approx([1.0])


def test_no_rows_no_successors() -> None:
    found = scrambled().successors(*random_rows(MIXED, 3, 0), 16, seed=0)
    assert found.offsets.tolist() == [0]
    assert found.states.shape == (0, len(MIXED))


def test_large_requests_are_worked_on_in_parts() -> None:
    model = scrambled((2, 2), 2)
    states, actions = random_rows((2, 2), 2, 5000)
    found = model.successors(states, actions, 8, seed=0)
    for part in (slice(0, 1), slice(4999, 5000), slice(2047, 2049)):
        few, span = model.successors(states[part], actions[part], 8, seed=0), slice(*found.offsets[[part.start, part.stop]])
        assert np.array_equal(few.states, found.states[span])
        assert np.array_equal(few.probabilities, found.probabilities[span])


def test_offsets_of_seeds_are_spread_evenly() -> None:
    offsets = np.sort([start(seed)[1] for seed in range(400)])
    assert np.abs(offsets - (np.arange(400) + 0.5) / 400).max() < 0.09


def test_long_lists_are_thinned_to_systematic_draws_and_short_ones_kept() -> None:
    rng = np.random.default_rng(0)
    following, ends = outcomes((5, 5))
    long, short = rng.dirichlet(np.ones(50)), np.array([0.25, 0.75])
    full = Successors(
        np.array([0, 50, 52, 102]),
        np.concatenate([following, following[:2], following]),
        np.concatenate([ends, ends[:2], ends]),
        np.concatenate([long, short, long]),
    )
    total = np.zeros(50)
    for seed in range(300):
        rows = rows_of(thin(full, 24, seed), (5, 5))
        assert rows[1] == {0: 0.25, 1: 0.75}
        assert rows[0] == rows[2]
        assert set(np.flatnonzero(long >= 1 / 24)) <= set(rows[0])
        assert all(abs(weight - long[k]) <= 1 / 24 for k, weight in rows[0].items())
        total[list(rows[0])] += list(rows[0].values())
    assert np.abs(total / 300 - long).max() < 0.01
    assert thin(full, 50, 0) is full
