"""Tables, pictures and recording of the car experiment: what they say is what was measured."""

from __future__ import annotations

import pytest
from PIL import Image

from safedpa_lab.experiments.car_episodes import Outcome
from safedpa_lab.experiments.car_figures import write_figures
from safedpa_lab.experiments.car_methods import METHODS
from safedpa_lab.experiments.car_report import MODEL_TITLES, markdown_of
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.car_style import METHOD_COLOURS, MODELS
from safedpa_lab.experiments.car_table import cell_of, table_markdown


def outcome(seed, success, safe, ticks=100, covered=(95, 100)):
    statuses = {"passed": ticks - 10, "corrected": 10}
    contact = "" if safe else "car against obstacle 0 at t=1.00 s, 1.00 m/s"
    return Outcome(seed, success, safe, ticks, contact, int(not safe), 10, 0.1, statuses,
                   {"obstacle": list(covered)}, "")  # fmt: skip


@pytest.fixture
def cell():
    """Four episodes: both, reached with a contact, safe but late, neither."""
    drives = [outcome(0, True, True, 80), outcome(1, True, False, 120), outcome(2, False, True, 300),
              outcome(3, False, False, 300)]  # fmt: skip
    return cell_of(METHODS["safedpa"], "box", drives)


def test_the_table_shows_the_cells_and_the_paper(cell):
    text = table_markdown([cell])
    assert "| SafeDPA | 0.50 / 0.50 / 0.25 |" in text
    assert "| *the paper's SafeDPA* | 1.00 / 0.90 / - |" in text
    assert "| SafeDPA | Box | 4 | 0.50 [0.15, 0.85] | 0.50 [0.15, 0.85] | 0.25 [0.05, 0.70] | 5.0 | 5 % |" in text


def test_only_what_was_run_is_written(cell, tmp_path):
    result = {"seeds": [0, 3], "left_out": ["Mix is left out: it is not there"], "cells": [cell]}
    assert "Mix is left out: it is not there." in markdown_of(result)
    assert "error over" not in markdown_of(result)
    written = write_figures(result, tmp_path)
    assert [path.name for path in written] == ["car_table.png"]
    with Image.open(written[0]) as picture:
        blue = sum(count for count, colour in picture.convert("RGB").getcolors(10**6) if colour == (0, 114, 178))
        bars = 0.5 + 0.5 + 0.25
        assert blue > 1000 * bars  # SafeDPA's bars are drawn in its colour


def test_every_method_model_and_configuration_has_a_look_of_its_own():
    assert METHOD_COLOURS.keys() == METHODS.keys()
    assert len(set(METHOD_COLOURS.values())) == len(METHODS)
    assert MODELS.keys() == MODEL_TITLES.keys()
    assert len({(line, marker) for _, line, marker in MODELS.values()}) == len(MODELS)
    assert list(CONFIGURATIONS.values()) == ["Box", "Chair", "Car", "Large Chair"]
