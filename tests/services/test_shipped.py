"""Shipped models, settings and margins fit together."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.dynamics import Setting, fingerprint, load_model
from safedpa.errors import InputError
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings, MarginCalibration, defaults
from safedpa.safety.defaults import margin_for, settings_named


def test_the_shipped_margin_belongs_to_the_shipped_car() -> None:
    margin = margin_for(load_model("car"))
    assert margin is not None
    assert margin.fingerprint == fingerprint(load_model("car"))
    assert margin.coverage >= 0.99
    assert margin.transitions > 5000


@pytest.mark.parametrize(
    ("name", "hertz"),
    [
        ("car", (10, 5)),
        ("car_measured", (10, 5)),
        ("pendulum", (50, 25)),
        ("differential_drive", (10, 5)),
        ("car_learned", ()),
        ("pendulum_learned", ()),
    ],
)
def test_shipped_robots_have_margins_for_longer_steps_besides_their_own(name: str, hertz: tuple[int, ...]) -> None:
    """Each margin has its own file, with the same kinds; a named one is loaded alone. Networks have one rate."""
    model = load_model(name)
    margin = margin_for(model)
    assert margin is not None
    assert margin.period == model.period
    reported = [margin_for(model, f"{name}_{rate}_hz") for rate in hertz]
    alone = [one for one in reported if one is not None]
    assert [one.period for one in alone] == [1.0 / rate for rate in hertz]
    assert margin.slower == {f"{one.period:g}": one.epsilon for one in alone}
    for one in alone:
        assert set(one.epsilon) == set(margin.epsilon)
        assert (one.slower, one.fingerprint) == ({}, margin.fingerprint)
        assert (one.coverage, one.drives) == (0.99, 150)
        counted = [share for kind, share in one.covered.items() if kind.startswith("conformal.")]
        assert len(counted) == len(one.epsilon)
        assert min(counted) >= one.coverage, "of the steps of fresh drives; what covered less does not ship"
        assert margin.for_period(one.period, model.period)[1] == 1.0, "so the filter promises it"


def test_a_file_of_longer_steps_that_covers_less_promises_no_more_for_the_others(monkeypatch, tmp_path):
    """Independent of the order of the files; a margin with a larger coverage may replace one with a smaller."""
    model = load_model("car")
    own = replace(MarginCalibration({"obstacle": 0.01}, 0.9, 100, "2026-11-28", fingerprint(model)), period=0.05)
    reported = {"a": (0.1, 0.8), "b": (0.05, 0.9), "c": (0.4, 0.99), "d": (0.2, 0.9)}
    (tmp_path / "named_margins").mkdir()
    for name, (period, coverage) in reported.items():
        replace(own, period=period, coverage=coverage).save(tmp_path / "named_margins" / f"{name}.toml")
    monkeypatch.setattr(defaults, "files", lambda _: tmp_path)
    assert margin_for(model) == replace(own, slower={"0.2": own.epsilon, "0.4": own.epsilon})


def test_another_model_has_no_shipped_margin_and_refuses_this_one() -> None:
    other = load_model("car").with_settings({"base.speed_gain": Setting(2.0)})
    assert margin_for(other) is None
    with pytest.raises(InputError, match="calibrate"):
        SafetyFilterNode(other, settings_named("car"), margin_for(load_model("car")))


def test_comments_do_not_change_the_fingerprint_but_values_do() -> None:
    model = load_model("car")
    assert fingerprint(model) == fingerprint(model.with_latent(np.array(model.latent)))
    assert fingerprint(model) != fingerprint(model.with_settings({"base.wheelbase": Setting(0.33)}))


def test_unknown_names_list_what_ships() -> None:
    with pytest.raises(InputError, match="did you mean 'car'"):
        settings_named("cars")


@pytest.mark.parametrize("ending", ["", ".toml"])
def test_a_file_that_is_not_in_the_folder_where_it_was_looked_for_is_none_that_ships(tmp_path: Path, ending: str):
    """A path with a folder means a file of the user, not a shipped one of the same name."""
    stem = "car_10_hz"
    assert margin_for(load_model("car"), f"{stem}{ending}") is not None
    for asked, name in ((settings_named, "car"), (lambda source: margin_for(load_model("car"), source), stem)):
        with pytest.raises(InputError, match=rf"{name}{ending}: no such file, nor one that ships under that name"):
            asked(str(tmp_path / f"{name}{ending}"))


def test_a_declared_robot_has_its_own_settings_unless_a_file_has_its_name(monkeypatch, tmp_path):
    class Declared:
        def settings(self) -> FilterSettings:
            return FilterSettings.for_robot("car", eta=0.9)

    known = {"own": Declared(), "car": Declared()}
    monkeypatch.setattr(defaults, "robots", lambda: known)
    monkeypatch.setattr(defaults, "robot_named", known.__getitem__)
    monkeypatch.chdir(tmp_path)
    assert settings_named("own").eta == 0.9
    assert settings_named("car").eta != 0.9, "what ships under that name"
    Path("own").write_text('system = "car"\neta = 0.4')
    assert settings_named("own").eta == 0.4
