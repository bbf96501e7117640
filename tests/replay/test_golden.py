"""Recorded runs that must come out as they were: a change of a latent, a nominal action or a verdict is noticed here.

On purpose: ``python tests/replay/golden/record.py --why "..."``.
"""

import dataclasses
import json
import runpy
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import SetupMessage, VerdictMessage
from safedpa.replay import setups
from safedpa.replay.replay import replay
from safedpa.replay.tape import RobotTape, gaps_of, read_tape
from safedpa.safety.settings import FilterSettings, parse_settings

GOLDEN = Path(__file__).parent / "golden"
RECORD = runpy.run_path(str(GOLDEN / "record.py"))
NAMES = sorted(path.stem for path in GOLDEN.glob("*.mcap"))


def tape_of(name: str) -> RobotTape:
    return read_tape([GOLDEN / f"{name}.mcap"])


def test_they_are_there_and_small() -> None:
    assert NAMES == ["car_box", "car_killed", "car_learned", "pendulum"]
    assert sum(path.stat().st_size for path in GOLDEN.glob("*.mcap")) < 500_000


@pytest.mark.parametrize("name", NAMES)
def test_each_golden_run_that_was_recorded_again_has_a_reason_and_its_differences(name: str) -> None:
    """A file lists the checksum of each, with the reason and the fields in which the former one differed."""
    changes = json.loads((GOLDEN / "changes.json").read_text(encoding="utf-8"))
    assert changes.keys() == set(NAMES)
    newest = changes[name][-1]
    assert newest["sha256"] == RECORD["sum_of"](GOLDEN / f"{name}.mcap"), "recorded without record.py"
    assert all(len(entry["why"]) > 20 for entry in changes[name])
    assert sorted(entry["date"] for entry in changes[name]) == [entry["date"] for entry in changes[name]]


def test_what_differs_is_listed_by_field_with_ticks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a program that decides otherwise; by this one nothing does."""
    path = GOLDEN / "car_box.mcap"
    assert RECORD["differing_fields"](path) == []
    monkeypatch.setattr(setups, "parse_settings", lambda text: dataclasses.replace(parse_settings(text), eta=0.01))
    differing = RECORD["differing_fields"](path)
    by_field = {row["field"]: row for row in differing}
    assert {"verdict.action", "action.values"} <= by_field.keys()
    row = by_field["action.values"]
    assert 0 < row["ticks"] <= row["of"] == len(tape_of("car_box").states)
    assert row["recorded"] != row["replayed"]
    for _ in range(2):
        RECORD["retained"](tmp_path / "changes.json", "car_box", "eta is a tenth", differing, path)
    first, second = json.loads((tmp_path / "changes.json").read_text(encoding="utf-8"))["car_box"]
    assert first == second
    assert (first["why"], first["differing"], first["sha256"]) == ("eta is a tenth", differing, RECORD["sum_of"](path))


def test_nothing_is_recorded_without_a_reason(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        RECORD["main"](["car_box"])
    assert "--why" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        RECORD["main"](["car_boks", "--why", "it shall"])
    assert "car_boks: wanted one of car_box, " in capsys.readouterr().err


@pytest.mark.parametrize("name", NAMES)
def test_a_golden_run_comes_out_as_it_was(name: str) -> None:
    tape = tape_of(name)
    assert not tape.findings
    assert not gaps_of(tape)
    found = replay(tape)
    assert found.agrees, [(part.service, part.differing[:3], part.spans) for part in found.services]
    for part in found.services:
        assert part.spans == [], "all outputs are compared"
        assert sum(part.compared.values()) >= len(tape.computed[part.service]) > 0


def test_their_services_really_died_and_inputs_were_really_missing() -> None:
    tape = tape_of("car_killed")
    assert {name: len(tape.setups[name]) for name in setups.REPLAYED} == dict.fromkeys(setups.REPLAYED, 2)
    verdicts = [entry.message for entry in tape.computed["safety_filter"]]
    stale = [verdict for verdict in verdicts if any(published == 0.0 for _, published in verdict.consumed)]
    assert len(stale) > 10
    without_nominal, without_latent = set[str](), set[str]()
    for verdict in stale:
        assert isinstance(verdict, VerdictMessage)
        (_, latent), (_, nominal) = verdict.consumed
        (without_nominal if nominal == 0.0 else without_latent).add(verdict.status)
        assert (latent == 0.0) != (nominal == 0.0), "one service is killed at a time"
    assert without_nominal == {"fallback"}
    assert without_latent == {"passed"}, "the last latent serves for a while"
    assert len(verdicts) < len(tape.states)


@pytest.mark.parametrize("name", ["car_box", "pendulum"])
def test_a_filter_that_decides_otherwise_breaks_them(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def otherwise(text: str) -> FilterSettings:
        settings = parse_settings(text)
        return dataclasses.replace(settings, eta=0.5 * settings.eta)

    monkeypatch.setattr(setups, "parse_settings", otherwise)
    found = replay(tape_of(name))
    assert not found.agrees
    assert {item.topic for part in found.services for item in part.differing} <= {"verdict", "action"}


def test_an_estimator_that_learns_a_little_differently_breaks_them(monkeypatch: pytest.MonkeyPatch) -> None:
    real = setups.AdaptationNode

    def otherwise(model: Any) -> Any:
        from safedpa.adaptation import EstimatorSettings

        return real(model, EstimatorSettings(drift_per_second=0.1501))

    monkeypatch.setattr(setups, "AdaptationNode", otherwise)
    found = replay(tape_of("car_box"))
    assert {item.topic for part in found.services for item in part.differing} == {"latent"}


def test_the_model_of_a_setup_is_read_back_as_it_was() -> None:
    setup = tape_of("car_learned").setups["adaptation"][0][1]
    assert isinstance(setup, SetupMessage)
    node = setups.node_of(setup)
    assert node.model_of("r1") == setup.fingerprint
