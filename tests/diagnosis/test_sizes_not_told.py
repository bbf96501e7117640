"""Effects that help together but whose sizes the data do not tell: undecided, with what is open."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.search.closest import doubtful_effects
from safedpa.diagnosis.search.progress import Judged
from safedpa.report.undecided_story import unsure_sentence


def found(values, deviations):
    """A search that accepted a drag and a saturation, whose limit does something at every value."""
    paths = ("viscous_drag.coefficient", "steering_saturation.limit")
    neutral = {paths[0]: 0.0, paths[1]: None}
    model = SimpleNamespace(parameters={path: SimpleNamespace(neutral=neutral[path]) for path in paths})
    fit = SimpleNamespace(paths=paths, values=np.array(values), model=model, deviations=lambda _: np.array(deviations))
    from safedpa.diagnosis.fit.trial import Trial

    current = Trial((), fit, np.zeros(1), np.zeros(1), 0.0)
    items = [
        Judged(0, Trial((path.split(".")[0],), fit, np.zeros(1), np.zeros(1), 0.0), 5.0, None, "accepted", "", ())
        for path in paths
    ]
    added = ["viscous_drag", "steering_saturation"]
    return SimpleNamespace(current=current, candidates=items, added=added, shooting=None)


@pytest.mark.parametrize(("deviation", "names"), [(0.1, []), (6.2, ["viscous_drag"]), (float("nan"), ["viscous_drag"])])
def test_an_effect_within_one_deviation_of_nothing_is_doubtful(deviation, names):
    """A limit without a value at which it does nothing is never."""
    items = doubtful_effects(found([0.8, 0.5], [deviation, 9.0]))
    assert [item.trial.name for item in items] == names
    assert all("within one deviation" in item.reason for item in items)


def test_the_sentence_says_what_helps_and_which_size_is_open():
    value = {"value": 0.8, "std": 6.2, "unit": "1/s"}
    document = {
        "added": ["viscous_drag", "understeer"],
        "closest": [{"effect": "viscous_drag", "parameters": {"viscous_drag.coefficient": value}}],
    }
    said = unsure_sentence(document, "viscous_drag and understeer", 0.55, 0.12)
    assert said.startswith(
        "Undecided: with viscous_drag and understeer the error on such driving falls from 0.55 to 0.12"
    )
    assert "coefficient 0.8 +- 6.2 1/s" in said
    assert "understeer (" not in said
