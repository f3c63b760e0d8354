import numpy as np
import pytest

from studies.sampling_accuracy.data import DataOptions, generate
from studies.sampling_accuracy.trials import TRIALS, find_trial


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
def test_sizes_are_those_of_the_paper(trial: object) -> None:
    options = find_trial(trial.name).options  # type: ignore[attr-defined]
    data = generate(options, seed=0)
    assert data.inputs.shape == (options.d**2, options.d)
    assert data.outputs.shape == (options.d**2, options.c, options.d)
    assert len(np.unique(data.inputs, axis=0)) == options.d**2
    assert set(np.unique(data.outputs)) == {0, 1}


def test_equal_seeds_give_equal_data_and_others_do_not() -> None:
    options = DataOptions(8, 5)
    assert (generate(options, 1).outputs == generate(options, 1).outputs).all()
    assert (generate(options, 1).outputs != generate(options, 2).outputs).any()


def pairs(options: DataOptions, seeds: int = 40) -> np.ndarray:
    """|correlation| of the two output variables within each input, over many draws, mean over inputs and seeds."""
    found = []
    for seed in range(seeds):
        signs = 2.0 * generate(options, seed).outputs - 1.0
        found.append(np.abs((signs[:, :, 0] * signs[:, :, 1]).mean(axis=1)))
    return np.concatenate(found)


def test_outputs_are_fair_coins_that_depend_on_each_other_as_r_says() -> None:
    # Two variables with r uniform in [-1, 1]: they agree with probability (1 + r) / 2, so E|correlation| = E|r| = 1/2.
    many = DataOptions(2, 4000)
    assert pairs(many).mean() == pytest.approx(0.5, abs=0.12)  # 160 inputs, standard deviation 0.29 each: 5 errors
    assert pairs(DataOptions(2, 4000, correlated=False)).mean() < 0.03
    # Copies of the input's variables leave the output's variables independent of each other when d = 2:
    # both orders give each variable its own coin or its own copy.
    outputs = generate(DataOptions(2, 4000, relates="input"), 0).outputs.mean(axis=(0, 1))
    np.testing.assert_allclose(outputs, 0.5, atol=0.26)


def test_under_the_literal_reading_an_output_copies_its_input() -> None:
    options = DataOptions(6, 3000, relates="input", shuffle="input")
    data = generate(options, 3)
    signs, inputs = 2.0 * data.outputs - 1.0, 2.0 * data.inputs - 1.0
    means = signs.mean(axis=1)  # [N, d]: +-|r| where copied, 0 for the first of the order
    centred = signs - means[:, None]
    covariance = np.einsum("ncd,nce->nde", centred, centred) / options.c
    off = covariance[:, ~np.eye(6, dtype=bool)]
    assert np.abs(off).max() < 6 / np.sqrt(options.c)  # independent given the input
    assert np.abs(means * inputs).max() > 0.5


def test_a_multiplier_takes_a_share_of_the_inputs() -> None:
    assert generate(DataOptions(8, 2, multiplier=0.25), 0).inputs.shape == (16, 8)
    assert generate(DataOptions(32, 2, multiplier=0.05), 0).inputs.shape == (51, 32)


def test_transitions_hold_every_observation() -> None:
    data = generate(DataOptions(3, 4), 0)
    rows = data.dataset().rows()
    assert len(rows) == 8 * 4
    np.testing.assert_array_equal(rows.next_states.reshape(8, 4, 3), data.outputs)


@pytest.mark.parametrize(("kwargs", "message"), [({"d": 0}, "d must"), ({"c": 0}, "c must"), ({"multiplier": 0.0}, "b must")])
def test_impossible_parameters_are_named(kwargs: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DataOptions(**{"d": 2, "c": 2, **kwargs})  # type: ignore[arg-type]


def test_a_trial_that_does_not_exist_is_named() -> None:
    with pytest.raises(ValueError, match="no trial '4'; choose from 1a, 1b"):
        find_trial("4")
