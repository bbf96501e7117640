"""A place on the floor is of one room: it is not looked for across recordings that were elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case

pytestmark = [pytest.mark.long, pytest.mark.slow]

CARPET = {"rolling_resistance": {"deceleration": 1.2, "at_x": 1.8, "at_y": 0.8, "radius": 1.5}}


def test_a_rough_patch_is_not_told_across_rooms(tmp_path, monkeypatch):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [])
    log = write_case(
        Case("test", 194365079, CARPET, runs=4, seconds=40.0, laws={"rolling_resistance": "where circle"}), tmp_path
    )
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    together = diagnose(model, runs)
    assert together.unexplained.kind == "place"
    assert "different_places" not in {item["kind"] for item in together.data_quality}
    apart = [replace(run, states=run.states + np.array([100.0 * k, 0.0, 0.0, 0.0])) for k, run in enumerate(runs)]
    elsewhere = diagnose(model, apart)
    assert elsewhere.unexplained is None or elsewhere.unexplained.kind != "place"
    assert "different_places" in {item["kind"] for item in elsewhere.data_quality}
