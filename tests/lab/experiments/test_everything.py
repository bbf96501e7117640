"""All experiments by one command: each is asked for as it wants to be, and what is made is not made again."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import click
import pytest

from safedpa.errors import InputError
from safedpa_lab.commands.experiment import EXPERIMENTS
from safedpa_lab.commands.experiment import command as experiment
from safedpa_lab.experiments.everything import ELSEWHERE, PARTS, Part, chosen, make
from safedpa_lab.provenance.record import KEY
from safedpa_services.command_line.group import safedpa

DRIVES = ("controllers", "--seeds", "1", "--controller", "goal_seeker")
QUICK = Part("controllers", DRIVES, ("--seconds", "1"), 2)
"""One of the experiments that need no torch: what is looked at is how they are made, not which."""
BAD = Part("bad", ("controllers", "--controller", "no_such_controller"), (), 1)


def test_every_experiment_is_a_part_or_is_said_why_not() -> None:
    asked = {part.words[0] for part in PARTS}
    assert asked | set(ELSEWHERE) == set(EXPERIMENTS)
    assert not asked & set(ELSEWHERE)
    assert len({part.name for part in PARTS}) == len(PARTS)


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_each_part_is_asked_for_as_its_command_wants(part: Part, small: bool, tmp_path: Path) -> None:
    first, name, *words = part.command(tmp_path, tmp_path, small=small)
    assert first == "experiment"
    with click.Context(experiment) as context:
        found = experiment.get_command(context, name)  # type: ignore[attr-defined]
        found.make_context(name, words)  # raises for an option that there is not, or a value of another kind


def test_no_part_writes_into_another_one_s_place(tmp_path: Path) -> None:
    places = {part.result(tmp_path) for part in PARTS}
    assert len(places) == len(PARTS)
    assert all(place.parent == tmp_path / part.name for part in PARTS for place in [part.result(tmp_path)])


def test_unknown_names_and_missing_recordings_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"--only safty: .*safety"):
        chosen(("safty",), None)
    with pytest.raises(InputError, match="real-logs: got no --data"):
        chosen(("real-logs",), None)
    with pytest.raises(
        InputError, match="car-paper: no learned/car_paper; 'safedpa train car --configuration car_paper'"
    ):
        chosen(("car-paper",), None)
    left_out = {part.name for part in PARTS} - {part.name for part in chosen((), None)}
    assert left_out == {"real-logs", "car-paper", "car-planner", "car-curves-paper", "tuning-real"}
    (tmp_path / "learned" / "car_paper").mkdir(parents=True)
    assert chosen((), tmp_path) == list(PARTS)


@pytest.mark.long
def test_a_result_of_the_current_code_is_not_made_again(tmp_path: Path) -> None:
    said: list[str] = []

    def tell(part: Part, words: str) -> None:
        said.append(f"{part.name} {re.sub(r'[0-9.]+', 'N', words)}")

    runs, done, old = (
        f"{QUICK.name} {words}"
        for words in ("runs; about N minutes", "done in N s", "made before, by the code of today")
    )
    first = make([QUICK], tmp_path, small=True, tell=tell)
    assert said == [runs, done]
    assert first["controllers"]["exit_code"] == 0
    assert json.loads((tmp_path / "all.json").read_text()) == first
    assert make([QUICK], tmp_path, small=True, tell=tell) == first
    assert said[2:] == [old]

    result = QUICK.result(tmp_path)
    document: dict[str, Any] = json.loads(result.read_text())
    document[KEY]["code"]["safedpa.safety"] = "0" * 12
    result.write_text(json.dumps(document))
    make([QUICK], tmp_path, small=True, tell=tell)
    assert said[3:] == [runs, done], "its code is another one by now"

    result.unlink()
    make([QUICK], tmp_path, small=True, tell=tell)
    assert said[5:] == [runs, done], "it is gone"


@pytest.mark.long
def test_a_small_result_does_not_replace_the_whole_experiment(tmp_path: Path) -> None:
    part = Part("controllers", (*DRIVES, "--seconds", "2"), ("--seconds", "1"), 2)
    make([part], tmp_path, small=True)
    make([part], tmp_path)
    assert "--seconds 2" in json.loads(part.result(tmp_path).read_text())[KEY]["command"]


@pytest.mark.long
def test_an_experiment_that_fails_is_reported_and_the_others_run(tmp_path: Path) -> None:
    account = make([BAD, QUICK], tmp_path, small=True)
    assert account["bad"]["exit_code"] != 0
    assert "no_such_controller" in account["bad"]["last_words"]
    assert account["controllers"]["exit_code"] == 0
    said: list[str] = []
    make([BAD], tmp_path, small=True, tell=lambda _part, words: said.append(words))
    assert said[0].startswith("runs"), "what failed is tried again"


@pytest.mark.long
def test_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["experiment", "all", "--list"]) == 0
    listed = capsys.readouterr().out
    assert all(f"safedpa experiment {' '.join(part.words)}" in listed for part in PARTS)
    assert safedpa.run(["experiment", "all"]) == 2
    assert "wanted a folder" in capsys.readouterr().err
    words = ["experiment", "all", "--small", "--only", "controllers", "--out", str(tmp_path / "new" / "all"), "--json"]
    assert safedpa.run(words) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["controllers"]["exit_code"] == 0
    assert "1 of 1: controllers: done" in told.err
