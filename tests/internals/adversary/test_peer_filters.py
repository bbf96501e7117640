"""How peers' problems are packed: the peers that read them are not installed here."""

import numpy as np

from safedpa_lab.experiments.adversary.peer_filters import _Parts


def test_the_parts_of_a_problem_lie_one_behind_the_other() -> None:
    """2 + 2 + 2 * 3 + 4 * 2 + 4 numbers."""
    problem = {
        "state": np.arange(2.0), "f": 10.0 + np.arange(2.0), "g": 20.0 + np.arange(6.0).reshape(2, 3),
        "P": 30.0 + np.arange(8.0).reshape(4, 2), "q": 40.0 + np.arange(4.0), "nominal": np.zeros(3),
    }  # fmt: skip
    parts = _Parts(problem)
    assert (parts.states, parts.actions, parts.size) == (2, 3, 22)
    packed = parts.packed(problem)
    assert len(packed) == 22
    for name in ("state", "f", "g", "P", "q"):
        np.testing.assert_array_equal(parts(packed, name), problem[name])
