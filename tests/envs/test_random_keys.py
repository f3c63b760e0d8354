import numpy as np
import pytest

from mbagent_envs.random_keys import derive, derive_one, draw_keys, uniform_at, uniforms

EXPECTED_UNIFORMS = [[0.8833108082136426, 0.43152799704850997], [0.7497482413580301, 0.37239342287916577]]


def test_numbers_are_uniform_for_any_keys() -> None:
    spread = np.random.default_rng(0).integers(0, 2**64, size=20_000, dtype=np.uint64)
    for keys in (np.arange(20_000), np.arange(20_000) << 40, spread):
        drawn = uniforms(keys, 4)
        assert drawn.shape == (20_000, 4)
        assert drawn.min() >= 0
        assert drawn.max() < 1
        counts = np.array([np.histogram(column, bins=20, range=(0, 1))[0] for column in drawn.T])
        chi_square = ((counts - 1000) ** 2 / 1000).sum(axis=1)
        assert (chi_square < 50).all()  # 19 degrees of freedom: 50 is exceeded with probability 1/7,000
        assert np.abs(np.corrcoef(drawn.T) - np.eye(4)).max() < 0.03  # columns independent
        assert abs(np.corrcoef(drawn[:-1, 0], drawn[1:, 0])[0, 1]) < 0.03  # so are neighbouring keys


def test_a_row_depends_on_its_own_key_only() -> None:
    keys = draw_keys(np.random.default_rng(1), 100)
    together = uniforms(keys, 5)
    np.testing.assert_array_equal(together[40:41], uniforms(keys[40:41], 5))
    np.testing.assert_array_equal(together[:, :3], uniforms(keys, 3))
    np.testing.assert_array_equal(together[::-2], uniforms(keys[::-2], 5))
    np.testing.assert_array_equal(derive(keys, 3)[7:8], derive(keys[7], 3))


def test_compiled_code_draws_the_same() -> None:
    keys = draw_keys(np.random.default_rng(2), 10)
    assert [uniform_at(key, 2) for key in keys] == uniforms(keys, 3)[:, 2].tolist()
    assert [derive_one(key, np.uint64(9)) for key in keys] == derive(keys, 9).tolist()


def test_the_numbers_never_change() -> None:  # recorded seeds must keep their meaning across releases
    np.testing.assert_array_equal(derive(0, 1, 2), np.array([6471287870292904291], dtype=np.uint64))
    np.testing.assert_array_equal(uniforms([0, 1], 2), EXPECTED_UNIFORMS)


def test_derived_keys_are_new_and_independent() -> None:
    keys = draw_keys(np.random.default_rng(3), 2000)
    derived = [derive(keys, salt) for salt in range(5)] + [derive(keys, 1, 2), derive(keys, 2, 1)]
    assert len(np.unique(np.concatenate([keys, *derived]))) == 8 * 2000
    columns = np.stack([uniforms(some, 1)[:, 0] for some in (keys, *derived)])
    assert np.abs(np.corrcoef(columns) - np.eye(8)).max() < 0.09


def test_salts_may_be_arrays_and_one_key_may_serve_many() -> None:
    np.testing.assert_array_equal(derive(5, np.arange(3)), np.concatenate([derive(5, i) for i in range(3)]))
    np.testing.assert_array_equal(derive(np.arange(3), 4)[1:2], derive(1, 4))
    assert derive(np.empty(0, dtype=np.uint64), 1).shape == (0,)
    assert derive(-1, 0) == derive(2**64 - 1, 0)


def test_mistakes_are_named() -> None:
    with pytest.raises(TypeError, match="keys must be integers"):
        uniforms(np.zeros(3), 1)
    with pytest.raises(TypeError, match="keys must be integers"):
        derive(np.arange(3), 0.5)
    with pytest.raises(ValueError, match="equal length"):
        derive(np.arange(3), np.arange(2))
