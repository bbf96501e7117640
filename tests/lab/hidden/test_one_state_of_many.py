"""What no library explains may show in one state alone: it is unexplained, however good the other states are."""

from pathlib import Path

import pytest

from safedpa.dynamics.user_files import load_user_file_everywhere
from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed
from safedpa_lab.own_robots import models
from safedpa_lab.own_robots.cases import OwnCase, write_case

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.mark.parametrize(
    ("robot", "seed", "outside", "sentence"),
    [
        # The curve of the current looks like a limit and a gain; what remains is a curve again.
        ("own_joint", 704000112, "square_root", "of what remains of rate"),
        # A drag that grows with the command: the speed of the cart alone is predicted badly.
        ("own_crane", 539772176, "drag_by_action", "of the usual change of v remains"),
    ],
)
def test_what_one_state_shows_is_unexplained_although_effects_fit(
    tmp_path: Path, robot: str, seed: int, outside: str, sentence: str
) -> None:
    load_user_file_everywhere(Path(models.__file__))
    model, runs, _ = write_case(OwnCase("own_outside", robot, seed, {}, 1, outside), tmp_path)
    document = diagnosed(model, runs)
    assert document["verdict"] == "unexplained"
    assert sentence in document["remainder"]["sentence"]


@pytest.mark.parametrize("robot", ["own_servo", "own_crane", "own_omni"])
def test_of_a_robot_with_nothing_hidden_no_state_is_unexplained(tmp_path: Path, robot: str) -> None:
    load_user_file_everywhere(Path(models.__file__))
    model, runs, _ = write_case(OwnCase("own_none", robot, 91, {}, 1), tmp_path)
    document = diagnosed(model, runs)
    assert document["verdict"] == "nothing_missing"
    assert document["remainder"]["sentence"] == ""
