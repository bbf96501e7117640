"""A name that ships is read from the package, also where the working directory has a folder of that name."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from safedpa.dynamics import fingerprint, load_model, shipped_models
from safedpa.records.column_map.file import load_column_map, shipped_column_maps
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.systems.robots import robots
from safedpa_sim.training.configuration import configurations, load_configuration

ONE = load_model("car")
CALIBRATED = ("car", "car_10_hz", "car_measured", "differential_drive", "pendulum", "pendulum_learned")
KINDS: dict[str, tuple[Callable[[str], Any], tuple[str, ...]]] = {
    "model": (lambda name: fingerprint(load_model(name)), tuple(shipped_models())),
    "column map": (load_column_map, tuple(shipped_column_maps())),
    "settings": (settings_named, (*robots(), "car_throttle")),
    "margin": (lambda name: margin_for(ONE, name), CALIBRATED),
    "training": (lambda name: repr(load_configuration(name)), tuple(configurations())),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_of_the_same_name_hides_nothing_that_ships(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, names = KINDS[kind]
    monkeypatch.chdir(tmp_path)
    shipped = {name: read(name) for name in names}
    assert shipped
    for name in names:  # what `--out pendulum` leaves behind
        (tmp_path / name).mkdir()
    assert {name: read(name) for name in names} == shipped


def test_a_file_of_the_working_directory_is_preferred(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = Path(shipped_models()["pendulum"]).read_text(encoding="utf-8")
    (tmp_path / "car").write_text(text, encoding="utf-8")
    assert load_model("car").system.name == "pendulum"
