"""What one module stores and another one loads is the same: no field is lost on the way."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting, load_model, parse_model, save_model
from safedpa.effects import effect, effects_of
from safedpa.live.versions import ModelVersion, PersistedState, VersionFolder
from safedpa.perception.overrides import load_overrides, save_overrides
from safedpa.safety.margins.calibration import MarginCalibration, margin_from_text, margin_text

TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=12)
NAME = st.text("abcdefghij_0123456789", min_size=1, max_size=8)
COUNT = st.integers(0, 2**40)
SIZE = st.floats(0.0, 1e6)
KINDS = ("obstacle", "field", "speed")
TABLE = st.fixed_dictionaries(dict.fromkeys(KINDS, SIZE))
MARGINS = st.builds(
    MarginCalibration, epsilon=TABLE, coverage=st.floats(0.5, 0.999), transitions=st.integers(1, 10**6),
    date=st.just("2026-12-01"), fingerprint=NAME, theorem=TABLE, constants=st.dictionaries(NAME, SIZE, max_size=3),
    covered=st.dictionaries(NAME, st.floats(0.0, 1.0), max_size=3), drive=TABLE, drives=COUNT, origin=TEXT,
    period=st.just(0.05), slower=st.dictionaries(st.sampled_from(("0.1", "0.2")), TABLE, max_size=2),
)  # fmt: skip
VERSIONS = st.builds(
    ModelVersion, fingerprint=NAME, document=TEXT, margin=TEXT, change=COUNT, why=TEXT, who=TEXT, data=TEXT
)
STATES = st.builds(
    PersistedState, versions=st.lists(VERSIONS, min_size=1, max_size=3).map(tuple), change=COUNT, offered=NAME,
    rejected=st.lists(st.tuples(COUNT, NAME), max_size=3).map(tuple),
)  # fmt: skip
SWITCHES = st.dictionaries(
    NAME, st.dictionaries(st.tuples(st.sampled_from(("source", "zone")), NAME), st.booleans(), min_size=1), max_size=3
)
FEW = settings(max_examples=30, deadline=None)


@FEW
@given(margin=MARGINS)
def test_a_margin_as_text_and_as_a_file(margin: MarginCalibration, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert margin_from_text(margin_text(margin)) == margin
    path: Path = tmp_path_factory.mktemp("margin") / "margin.toml"
    margin.save(path)
    assert MarginCalibration.load(path) == margin


@FEW
@given(state=STATES)
def test_the_versions_of_a_model(state: PersistedState, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = VersionFolder(tmp_path_factory.mktemp("versions"))
    folder.save(state)
    assert folder.load() == state


@FEW
@given(switches=SWITCHES)
def test_orders_to_sensors(switches: object, tmp_path_factory: pytest.TempPathFactory) -> None:
    path: Path = tmp_path_factory.mktemp("orders") / "orders.json"
    assert save_overrides(path, switches) == ""  # type: ignore[arg-type]
    assert load_overrides(path) == (switches, "")


@pytest.mark.parametrize("robot", ["car", "pendulum", "point"])
def test_a_model_with_every_effect_and_every_kind_of_setting(robot: str, tmp_path: Path) -> None:
    model: PhysicsModel = load_model(robot)
    for name, item in effects_of(robot).items():
        if item.needs or name in {other.name for other in model.effects}:
            continue
        parts = [*item.parameters]
        given = {part.name: Setting(part.typical, free=at % 2 == 0) for at, part in enumerate(parts)}
        one = model.with_effect(effect(robot, name), given)
        save_model(one, tmp_path / "model.toml")
        again = load_model(tmp_path / "model.toml")
        assert again.settings == one.settings
        assert [other.name for other in again.effects] == [other.name for other in one.effects]
        assert (again.period, again.latent_names, again.base.kind) == (one.period, one.latent_names, one.base.kind)
        assert parse_model((tmp_path / "model.toml").read_text(encoding="utf-8")).settings == one.settings
