"""Search for the splits of a target: evidence against a closed form; true dependencies are found, and no others."""

import numpy as np
import pytest
from scipy import special

from mbagent.models.dbn.mutex import find_cliques, find_groups
from mbagent.models.dbn.score import (
    BY_ALL,
    BY_CONTEXT,
    Search,
    Target,
    best_split,
    count,
    evidence_tables,
    evidences,
    feature_blocks,
)
from mbagent.models.dbn.split_search import find_splits

RNG = np.random.default_rng(0)


def target(positives: np.ndarray, context: np.ndarray | None = None) -> Target:
    """A target over all rows; contexts are actions with one value."""
    context = np.zeros(len(positives), dtype=np.int64) if context is None else context
    n = int(context.max()) + 1
    once = np.ones(len(positives), dtype=np.int64)
    return Target(np.arange(len(positives)), once, positives.astype(np.int64), context, np.arange(n), np.zeros(n, dtype=np.int64))


def rates_of_rows(search: Search, table: np.ndarray) -> np.ndarray:
    """Share of positives in the context of each row."""
    n, e = search.counts()
    rates: np.ndarray = (e / np.maximum(n, 1))[search.target.context]
    assert len(rates) == len(table)
    return rates


def test_evidence_is_the_marginal_likelihood_under_a_beta_prior() -> None:
    tables = evidence_tables(40)
    for positives, n in ((0, 0), (0, 7), (3, 7), (40, 40)):
        exact = special.betaln(positives + 0.2, n - positives + 0.2) - special.betaln(0.2, 0.2)
        assert evidences(np.array([positives]), np.array([n]), tables)[0] == pytest.approx(exact)


def test_gain_of_the_best_split_agrees_with_direct_computation() -> None:
    table = RNG.random((300, 6)) < 0.4
    context = RNG.integers(3, size=300)
    positives = (table[:, 4] & (context != 1)) | (RNG.random(300) < 0.1)
    tables = evidence_tables(301)
    one = target(positives, context)
    chosen = best_split(one, count(one, feature_blocks(table)), np.full(6, -2.0), np.array([-50.0, -50.0, -3.0]), tables)

    def total(rows: np.ndarray) -> float:
        return float(evidences(positives[rows].sum(keepdims=True), np.array([rows.sum()]), tables)[0])

    before = [total(context == c) for c in range(3)]
    gains = {}
    for b in range(6):
        sides = [[total((context == c) & (table[:, b] == side)) for c in range(3)] for side in (False, True)]
        pooled = [max(sum(side), total(table[:, b] == on)) for on, side in zip((False, True), sides, strict=True)]
        gains[BY_ALL, 0, b] = sum(pooled) - sum(before) - 2.0
        for c in range(3):
            gains[BY_CONTEXT, c, b] = sides[0][c] + sides[1][c] - before[c] - 5.0
    best = max(gains, key=lambda key: gains[key])
    assert chosen.gain == pytest.approx(gains[best])
    assert (chosen.kind, chosen.which, chosen.feature) == best


def test_one_relevant_feature_is_found_from_little_data_and_no_others() -> None:
    table = RNG.random((120, 80)) < 0.3
    found = find_splits([target(table[:, 17])], table, np.zeros(80, dtype=np.int64), 1)[0]
    assert [split.feature for split in found.splits if split.feature >= 0] == [17]
    noise = find_splits([target(RNG.random(400) < 0.5)], RNG.random((400, 80)) < 0.3, np.zeros(80, dtype=np.int64), 1)[0]
    assert not noise.splits


@pytest.mark.parametrize("rule", ["xor", "and", "neither", "second only"])
def test_features_that_matter_only_jointly_are_found(rule: str) -> None:
    table = RNG.random((600, 40)) < 0.5
    first, second = table[:, 5], table[:, 31]
    positives = {"xor": first ^ second, "and": first & second, "neither": ~first & ~second, "second only": ~first & second}[rule]
    found = find_splits([target(positives)], table, np.zeros(40, dtype=np.int64), 1)[0]
    assert {split.feature for split in found.splits if split.feature >= 0} == {5, 31}
    np.testing.assert_array_equal(rates_of_rows(found, table), positives.astype(float))


def test_contexts_with_equal_rates_share_a_leaf_and_others_do_not() -> None:
    context = np.repeat(np.arange(4), 200)
    positives = RNG.random(800) < np.array([0.5, 0.5, 0.5, 0.5])[context]
    assert (
        len(
            find_splits([target(positives, context)], np.zeros((800, 1), dtype=np.bool_), np.zeros(1, np.int64), 4)[
                0
            ].target.action
        )
        == 1
    )
    positives = RNG.random(800) < np.array([0.05, 0.9, 0.05, 0.9])[context]
    assert (
        len(
            find_splits([target(positives, context)], np.zeros((800, 1), dtype=np.bool_), np.zeros(1, np.int64), 4)[
                0
            ].target.action
        )
        == 4
    )


def test_groups_of_bits_of_which_exactly_one_is_on_are_found_and_no_others() -> None:
    n, position, phase = 400, RNG.integers(6, size=401), RNG.integers(4, size=401)
    table = np.concatenate([np.eye(6)[position], np.eye(4)[phase], RNG.random((401, 5)) < 0.5], axis=1).astype(np.int64)
    table = np.concatenate([table, np.zeros((401, 1), dtype=np.int64)], axis=1)  # a bit that is never on
    order = RNG.permutation(16)
    mixed = table[:, order]
    found = find_groups((2,) * 16, mixed[:n], mixed[1:])
    expected = [tuple(sorted(np.flatnonzero(np.isin(order, members)))) for members in (range(6), range(6, 10))]
    assert sorted(found) == sorted(expected)
    mixed[7, np.flatnonzero(order == 0)] = 1 - mixed[7, np.flatnonzero(order == 0)]  # once, two are on, or none
    assert expected[0] not in find_groups((2,) * 16, mixed[:n], mixed[1:])
    assert find_groups((2, 2), mixed[:0, :2], mixed[:0, :2]) == ()


def test_bits_never_on_together_are_distinguished_from_bits_rarely_on_together() -> None:
    p, n = 0.05, 8000
    chosen = RNG.integers(20, size=n)  # 0 ... 3: one of four bits that exclude each other; else none of them
    free = RNG.random((n, 4)) < p
    table = np.concatenate([chosen[:, None] == np.arange(4), free], axis=1)
    order = RNG.permutation(8)
    on = table[:, order].astype(np.int64)
    expected = np.full((8, 8), n * p * p)
    cliques = find_cliques(on.T @ on, expected)
    assert [clique.tolist() for clique in cliques] == [sorted(np.flatnonzero(np.isin(order, range(4))).tolist())]
    assert find_cliques(on.T @ on, expected / 10) == []  # not significant if few joint occurrences are expected


def test_search_ends_with_a_bit_that_is_only_switched_off() -> None:
    before = np.zeros((50, 4), dtype=np.int64)
    before[:, 3] = 1
    before[0, :] = [0, 1, 0, 0]  # bit 1 is on once, before the first step only
    after = np.zeros((50, 4), dtype=np.int64)
    after[:, 2] = 1
    assert find_groups((2,) * 4, before, after) in ((), ((1, 2, 3),))
