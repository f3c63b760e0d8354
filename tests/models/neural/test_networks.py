import numpy as np
import pytest
import torch

from mbagent.models import Conditioner, DensePredictor, FactorCodec
from mbagent.models.neural.networks import MASKED_LOGIT, Dropout, Mask
from tests.models.helpers import MIXED, random_rows

CARDINALITIES = [(2, 2, 2), MIXED, (5,), (1, 2, 3)]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def rows(codec: FactorCodec, n: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    states, actions = random_rows(codec.cardinalities, codec.n_actions, n)
    following, _ = random_rows(codec.outputs, codec.n_actions, n, seed=1)
    return torch.from_numpy(states), torch.from_numpy(actions), torch.from_numpy(following)


@pytest.mark.parametrize("cardinalities", CARDINALITIES)
def test_columns_and_logits_distinguish_values(cardinalities: tuple[int, ...]) -> None:
    codec = FactorCodec(cardinalities, 2)
    _, _, following = rows(codec, 40)
    columns = codec.targets(following)
    assert columns.shape == (40, sum(1 if c == 2 else c for c in codec.outputs))
    logits = codec.logits(20.0 * columns - 10.0)
    assert torch.equal(logits.argmax(dim=2), following)
    impossible = np.arange(codec.width) >= np.asarray(codec.outputs)[:, None]
    assert (logits[:, torch.from_numpy(impossible)] == MASKED_LOGIT).all()


@pytest.mark.parametrize("mask", ["causal", "others"])
@pytest.mark.parametrize("cardinalities", CARDINALITIES)
def test_gradients_of_output_i_follow_its_mask(mask: Mask, cardinalities: tuple[int, ...]) -> None:
    codec = FactorCodec(cardinalities, 2)
    conditioner = Conditioner(codec, mask, 3, correction=False, generator=generator())
    states, actions, following = rows(codec)
    inputs, targets = codec.inputs(states, actions), codec.targets(following).requires_grad_()
    for i, cardinality in enumerate(codec.outputs):
        if cardinality == 1:
            continue
        # The last value of factor i: a softmax is invariant to a constant, single logits are not.
        output = conditioner.from_columns(inputs, targets)[:, i, cardinality - 1].sum()
        gradient = torch.autograd.grad(output, targets)[0].abs().sum(dim=0)
        for j in range(len(codec.outputs)):
            felt = bool((gradient[codec.column_factor == j] > 0).any())
            assert felt == (j < i if mask == "causal" else j != i), (i, j)


@pytest.mark.parametrize("mask", ["causal", "others"])
def test_pruned_weights_stay_zero_in_training(mask: Mask) -> None:
    codec = FactorCodec(MIXED, 2)
    conditioner = Conditioner(codec, mask, 3, generator=generator())
    pruned = conditioner.groups.mask
    assert pruned is not None
    optimizer = torch.optim.AdamW(conditioner.parameters(), lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        conditioner(*rows(codec)).clamp(min=-10).square().sum().backward()
        assert conditioner.groups.weight.grad is not None
        assert (conditioner.groups.weight.grad[~pruned] == 0).all()
        optimizer.step()
    assert (conditioner.groups.weight[~pruned] == 0).all()
    assert (conditioner.groups.weight[pruned] != 0).all()


def test_a_correction_starts_at_zero_and_stays_zero_without_a_group() -> None:
    codec = FactorCodec(MIXED, 2)
    fresh = Conditioner(codec, generator=generator())
    assert (fresh(*rows(codec))[:, codec.floor == 0] == 0).all()
    grouped = torch.tensor([True, False, False, True, False])
    some = Conditioner(codec, grouped=grouped, generator=generator())
    torch.nn.init.ones_(some.readout)
    corrected = (some(*rows(codec)).clamp(min=-100) != codec.floor.clamp(min=-100)).any(dim=2).any(dim=0)
    assert torch.equal(corrected, grouped)


@pytest.mark.parametrize("cardinalities", CARDINALITIES)
def test_an_untrained_predictor_predicts_no_change(cardinalities: tuple[int, ...]) -> None:
    codec = FactorCodec(cardinalities, 3)
    states, actions, _ = rows(codec, 30)
    logits = DensePredictor(codec, generator=generator())(states, actions)
    assert torch.equal(logits[:, :-1].argmax(dim=2), states)


def test_first_weights_come_from_the_generator_alone() -> None:
    codec = FactorCodec(MIXED, 3)
    before = torch.random.get_rng_state()
    networks = []
    for _ in range(2):
        source = generator(3)
        networks.append((DensePredictor(codec, generator=source), Conditioner(codec, generator=source)))
        torch.rand(1)  # advances the process-wide generator
    torch.random.set_rng_state(before)
    DensePredictor(codec, generator=generator(4))
    assert torch.equal(torch.random.get_rng_state(), before)
    for a, b in zip(*networks, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters(), strict=True))


def test_dropout_zeroes_its_share_keeps_the_mean_and_needs_a_generator() -> None:
    layer, ones = Dropout(0.4), torch.ones(200, 201)
    assert layer(ones) is ones
    layer.generator = generator()
    dropped = layer(ones)
    assert (dropped == 0).float().mean() == pytest.approx(0.4, abs=0.01)
    assert dropped.mean() == pytest.approx(1.0, abs=0.02)
    for axis in (0, 1):  # no row, no column, no byte of a word is favoured
        assert (dropped == 0).float().mean(dim=axis).std() == pytest.approx(np.sqrt(0.24 / 200), rel=0.2)
    by_byte = (dropped.flatten()[: 200 * 200].view(-1, 8) == 0).float().mean(dim=0)
    assert (by_byte - 0.4).abs().max() < 0.03


@pytest.mark.parametrize("cardinalities", CARDINALITIES)
def test_large_groups_computed_one_after_another_are_the_same(
    cardinalities: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    codec = FactorCodec(cardinalities, 2)
    conditioner = Conditioner(codec, "others", 5, correction=False, generator=generator())
    given = rows(codec)
    together = conditioner(*given)
    monkeypatch.setattr("mbagent.models.neural.networks.LARGE_GROUP", 1)
    torch.testing.assert_close(conditioner(*given), together)
