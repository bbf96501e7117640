"""What actions change in h."""

import numpy as np
import pytest

from safedpa.equations.chain_rule import chain_rule


@pytest.mark.parametrize(
    ("rows", "states", "actions"), [(1, 1, 1), (3, 2, 1), (2, 4, 3), (0, 2, 2), (3, 5, 2), (3, 3, 2), (2, 4, 1)]
)
def test_it_is_the_product_of_both(rows: int, states: int, actions: int) -> None:
    random = np.random.default_rng(rows)
    slopes, g = random.normal(size=(rows, states)), random.normal(size=(states, actions))
    found = chain_rule(slopes.tolist(), g.tolist())
    np.testing.assert_allclose(np.array(found).reshape(rows, actions), slopes @ g, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("slopes", [[1.0], [1.0, 2.0, 3.0]])
def test_slopes_of_other_states_are_refused(slopes: list[float]) -> None:
    with pytest.raises(ValueError, match=f"h has slopes of {len(slopes)} states, the model of 2"):
        chain_rule([[1.0, 1.0], slopes], [[1.0], [2.0]])


def test_rows_do_not_share_their_numbers() -> None:
    one, other = chain_rule([[1.0], [2.0]], [[3.0]])
    one[0] = 0.0
    assert other == [6.0]


def test_of_a_car_it_is_the_same_sum_in_the_same_order() -> None:
    random = np.random.default_rng(9)
    slopes, g = random.normal(size=(50, 4)).tolist(), random.normal(size=(4, 2)).tolist()
    slopes += [[-0.0, 0.0, -0.0, 0.0], [1e308, 1e308, -1e308, 1.0]]
    wanted = []
    for p in slopes:
        row = [0.0, 0.0]
        for slope, entries in zip(p, g, strict=True):
            row = [row[0] + slope * entries[0], row[1] + slope * entries[1]]
        wanted.append(row)
    assert repr(chain_rule(slopes, g)) == repr(wanted)
    assert repr(chain_rule([tuple(p) for p in slopes], g)) == repr(wanted)


@pytest.mark.parametrize("slopes", [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0, 5.0]])
def test_slopes_of_another_robot_than_a_car_are_refused(slopes: list[float]) -> None:
    with pytest.raises(ValueError, match=f"h has slopes of {len(slopes)} states, the model of 4"):
        chain_rule([[1.0, 1.0, 1.0, 1.0], slopes], [[1.0, 2.0]] * 4)


def test_of_no_state_nothing_changes() -> None:
    assert chain_rule([[], []], []) == [[], []]
