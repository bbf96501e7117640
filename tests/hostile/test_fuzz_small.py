"""A few seconds of the fuzzing command: mutated input opens no hole."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest

from safedpa_services.command_line.experiments.hostile_pages import page_targets
from safedpa_services.command_line.group import safedpa
from safedpa_sim.experiments.hostile.fuzz import fuzz
from safedpa_sim.experiments.hostile.mutations import mutated
from safedpa_sim.experiments.hostile.targets import Target

pytestmark = pytest.mark.slow


def test_some_seconds_of_mutated_input_open_no_hole(tmp_path: Path) -> None:
    with page_targets() as pages:
        tallies = fuzz(8.0, 1, tmp_path, further=pages)
    assert {tally.name: tally.holes for tally in tallies if tally.holes} == {}
    assert all(tally.inputs >= 20 for tally in tallies)
    assert sum(tally.refused for tally in tallies) > 100


def test_a_reader_with_a_hole_is_found(tmp_path: Path) -> None:
    def careless(data: bytes) -> None:
        if data != b"good":
            raise KeyError("planted")

    tallies = fuzz(0.2, 1, tmp_path, further=(Target("careless", (b"good",), careless),))
    assert tallies[-2].holes == ["KeyError: 'planted'"]
    assert [path.name for path in tmp_path.iterdir()] == ["careless-001.bin"]


def test_the_same_chance_gives_the_same_bytes() -> None:
    first, again = (mutated(random.Random(7), [b"good bytes"] * 2) for _ in range(2))
    assert first == again


def test_the_command_tells_every_target(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["experiment", "hostile", "--seconds", "0.5", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    names = {row["target"] for row in document["targets"]}
    assert {"message StateMessage", "offered model", "recording .mcap", "page's guard", "loop that drives"} <= names
