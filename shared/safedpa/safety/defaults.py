"""The settings and margins that ship with the project, by the name of the model that they belong to."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path

from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.dynamics.user_files import load_user_files
from safedpa.errors import InputError, did_you_mean
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.settings import FilterSettings, load_settings
from safedpa.systems.robots import robot_named, robots

__all__ = ["margin_for", "settings_named"]


def settings_named(source: str) -> FilterSettings:
    """Reads settings from a file, or returns those of the robot of that name. Raises InputError naming file and key.

    Example:

        >>> safedpa.settings_named("car").action_high
        (2.0, 0.34)
    """
    # A user's robots may be declared in files that the environment names; without them their names are unknown.
    load_user_files()
    declared = source in robots() and not Path(source).is_file() and source not in _shipped("named_settings")
    return robot_named(source).settings() if declared else load_settings(_path(source, "named_settings"))


def margin_for(model: PhysicsModel, source: str = "") -> MarginCalibration | None:
    """The calibration in a file or under a name; without ``source`` the shipped one of exactly this model, or None.

    It includes the shipped margins for longer steps. Raises InputError if it cannot be read.
    """
    if source:
        return MarginCalibration.load(_path(source, "named_margins"))
    shipped = map(MarginCalibration.load, _shipped("named_margins").values())
    # By fingerprint, not by name: a margin of a model with other parameters would promise a coverage that was never
    # measured.
    found = sorted((one for one in shipped if one.fingerprint == fingerprint(model)), key=lambda one: one.period)
    if not found:
        return None
    # A table with less coverage would weaken the promise of the whole calibration.
    slower = [one for one in found[1:] if one.coverage >= found[0].coverage]
    return replace(found[0], slower={f"{one.period:g}": one.epsilon for one in slower})


def _path(source: str, kind: str) -> Path:
    path = Path(source)
    shipped = _shipped(kind)
    # A file in the working directory takes precedence over a shipped name, as for all other file arguments; a folder
    # does not: the output of `--out pendulum` may lie there.
    if path.exists() and not (path.is_dir() and source in shipped):
        return path
    if path.stem not in shipped or path.parent != Path():
        raise InputError(
            f"{source}: no such file, nor one that ships under that name; {did_you_mean(path.stem, shipped)}"
        )
    return shipped[path.stem]


def _shipped(kind: str) -> dict[str, Path]:
    with as_file(files("safedpa.safety") / kind) as folder:
        return {path.stem: path for path in sorted(folder.glob("*.toml"))}
