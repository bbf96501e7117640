"""What a lag or a delay makes of a command changes within a row: the final numbers know it."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.compare.windows import windows_of
from safedpa.diagnosis.fit.refinement import refined
from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [("steering_lag", "time_constant", 0.143), ("steering_delay", "seconds", 0.114)],
)
def test_actuators_are_followed_within_each_row(tmp_path, name, parameter, value):
    """A mean over each row is off by 0.1 to 0.2 %, three stated deviations."""
    log = write_case(Case("test", 1793393573, {name: {parameter: value}}), tmp_path / "case")
    model = load_model(str(log.model))
    windows = windows_of([load_run(str(path), model.system) for path in log.runs], 1.0)
    path = f"{name}.{parameter}"
    begun = model.with_effect(effect("car", name), {parameter: Setting(0.993 * value)})
    found = refined(begun, [path], np.array([True]), windows)
    (std,) = found.deviations
    assert std < 4e-4 * value
    assert abs(found.model.settings[path].value - value) < 2.5 * std
