"""Which column map the dialog begins with: that of the file's own names where it has them, else one that fits."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from safedpa.dynamics import load_model
from safedpa_services.workbench import open_dialog
from safedpa_services.workbench.open_dialog import _GUESSED, _NATIVE, OpenDialog

OWN = ("t", "x", "y", "yaw", "speed", "target_speed", "steer")
DART = ("elapsed time sensors", "vicon x", "vicon y")


class Chosen:
    """A select that tells when it is given another value, as the page's does."""

    def __init__(self, value, on_change):
        self.__dict__.update(value=value, on_change=on_change)

    def __setattr__(self, name, value):
        changed = value != self.value
        self.__dict__[name] = value
        if changed:
            self.on_change()


@pytest.mark.parametrize(
    ("names", "before", "after"),
    [
        (OWN, _NATIVE, _NATIVE),
        ((*OWN, "battery"), _NATIVE, _NATIVE),
        (OWN, _GUESSED, _GUESSED),
        (OWN, "dart_car_columns", "dart_car_columns"),
        (("t", "px", "py"), _NATIVE, _GUESSED),
        (OWN[:-1], _NATIVE, _GUESSED),
        ((), _NATIVE, _NATIVE),
        (("t", "px", "py"), "dart_car_columns", "dart_car_columns"),
    ],
)
def test_the_files_own_names_are_taken_as_they_are_and_whatever_a_person_chose_stays(names, before, after, monkeypatch):
    """A file with every native column needs no guess; a recording of the bus, without columns, no map at all."""
    shown = []
    monkeypatch.setattr(open_dialog, "raw_rows", lambda _path: SimpleNamespace(names=names))
    dialog = object.__new__(OpenDialog)
    dialog._map_chosen = lambda: shown.append(dialog._map.value)
    dialog._map = Chosen(before, dialog._map_chosen)
    dialog._loaded_model = lambda: load_model("car")
    dialog._files_named = lambda: ["drive.csv"]
    dialog._refresh()
    assert dialog._map.value == after
    assert shown == [after], "the table is drawn once"
