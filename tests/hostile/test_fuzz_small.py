"""A few seconds of the fuzzing command: mutated input opens no hole."""

import json
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from safedpa_lab.experiments.hostile.fuzz import fuzz, mutated
from safedpa_lab.experiments.hostile.targets import Target, page_targets
from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.slow


@pytest.mark.long
def test_some_seconds_of_mutated_input_open_no_hole(tmp_path: Path) -> None:
    with page_targets() as pages:
        tallies = fuzz(8.0, 1, tmp_path, further=pages)
    assert {tally.name: tally.holes for tally in tallies if tally.holes} == {}
    assert all(tally.inputs >= 20 for tally in tallies)
    assert sum(tally.refused for tally in tallies) > 100


@pytest.mark.long
def test_a_table_that_contradicts_itself_does_not_end_the_process(tmp_path: Path) -> None:
    """In a process of its own: pyarrow would take this one with it."""
    script = (
        "import random, sys\n"
        "from pathlib import Path\n"
        "from safedpa.errors import InputError\n"
        "from safedpa.records import load_run\n"
        "from safedpa.robots.car.system import CAR\n"
        "from safedpa_lab.experiments.hostile.fuzz import mutated\n"
        "path, seed = Path(sys.argv[1]), Path(sys.argv[2]).read_bytes()\n"
        "chance = random.Random(2)\n"
        "for _ in range(1200):\n"
        "    path.write_bytes(mutated(chance, (seed,)))\n"
        "    try:\n"
        "        load_run(path, CAR)\n"
        "    except InputError:\n"
        "        pass\n"
    )
    columns = {name: np.linspace(0.0, 1.0, 60) for name in ("t", "x", "y", "yaw", "speed", "target_speed", "steer")}
    good = tmp_path / "good.parquet"
    parquet.write_table(pyarrow.table(columns), good)
    command = [sys.executable, "-c", script, str(tmp_path / "bad.parquet"), str(good)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-800:]


@pytest.mark.long
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


@pytest.mark.long
def test_the_command_reports_every_target(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["experiment", "hostile", "--seconds", "0.5", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    names = {row["target"] for row in document["targets"]}
    assert {"message StateMessage", "offered model", "recording .mcap", "page's guard", "loop that drives"} <= names
