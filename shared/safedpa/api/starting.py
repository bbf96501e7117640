"""``init``: from a log to a first model: which columns are states and commands, a base, and the files of a robot."""

from __future__ import annotations

import re
import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.api.fitting import refit
from safedpa.api.inputs import read_log
from safedpa.api.proposed_bases import (
    KINDS,
    WHOLE,
    ProposedBase,
    StateChain,
    base_of,
    bases_of_chain,
    coupled_base,
    fitted_start,
    follows,
    moving,
    needed_terms,
    planar_rates,
    turning_base,
    whole_robot,
)
from safedpa.api.recognised_columns import RecognisedColumns, unexplained_change
from safedpa.arrays import FloatArray
from safedpa.comparison.comparison import compare_model
from safedpa.comparison.output import refuse_inputs, require_writable_folder
from safedpa.dynamics import PhysicsModel, Setting, write_model
from safedpa.errors import InputError, RunError, SafedpaError, did_you_mean
from safedpa.extras import need
from safedpa.limits import printable
from safedpa.progress import progress
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.column_map.form import QuantityForm, map_text
from safedpa.records.column_map.propose import COMMANDED
from safedpa.records.column_map.recognise import changes, planar_motion, rate_pairs
from safedpa.records.run import Run, Stretch
from safedpa.result import AbstractResult
from safedpa.systems import System, Variable, systems

_TRAINING = 0.7
"""Share of the log on which the bases are fitted; they are compared on the rest."""
_OF_REST = 0.4
"""Share of the last part of a log that the default horizon lasts at most."""
_CLEARLY = 0.95
"""A later base is taken instead of a simpler one if its error is below this share of the simpler one's."""
_MOST_COUPLED = 8
"""States that are tried as driving each other at most: their coefficients grow with the square."""
_FURTHER = 0.7
"""Error, in units of the usual change, below which a state that only other states drive is predicted at all."""
_DERIVED_ROWS = 5
"""Window of a derived rate, in periods."""
_DRIVEN = 0.02
"""Least share of the unexplained changes of a state that a command must explain."""
_LEAST_PERIOD = 0.01
"""Shortest period of a proposed model, s; quicker logs are thinned."""


@final
@dataclass(frozen=True, repr=False, eq=False)
class StartedModel(AbstractResult):
    """A first model of a robot, from the tables ``logs``.

    ``system`` has the states and actions, ``kinds`` are the bases by state. ``error`` is that of the model on the last
    part of the log, as a share of the usual change after ``horizon`` [s], ``naive`` that of constant velocity;
    ``unused`` are columns of the log that are in no role. ``folder`` has the files robot.py (system, base, effects),
    model.toml and columns.toml; ``command`` diagnoses the model with the log.

    Example:

        >>> started = safedpa.init("degrees.csv", "my_pendulum", actions={"torque": "torque"})
        >>> started.system.state_names, started.kinds
        (('theta', 'rate'), {'theta': 'joint'})
    """

    folder: Path
    logs: tuple[Path, ...]
    system: System
    kinds: dict[str, str]
    error: float
    naive: float
    horizon: float
    unused: tuple[str, ...]

    @property
    def command(self) -> str:
        """The shell command that diagnoses the model."""
        files = {"--columns": self.folder / "columns.toml", "--effects": self.folder / "robot.py"}
        given = ["safedpa", "diagnose", str(self.folder / "model.toml"), *map(str, self.logs)]
        options = [text for option, path in files.items() for text in (option, str(path))]
        return shlex.join([*given, *options, "--horizon", f"{self.horizon:g}"])

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa init --json`` prints."""
        return {
            "folder": str(self.folder),
            "states": list(self.system.state_names),
            "actions": list(self.system.action_names),
            "bases": self.kinds,
            "error": self.error if np.isfinite(self.error) else None,
            "constant_velocity": self.naive if np.isfinite(self.naive) else None,
            "horizon": self.horizon,
            "unused": list(self.unused),
            "next": self.command,
        }

    def __str__(self) -> str:
        states = ", ".join(f"{item.name} [{item.unit}]" for item in self.system.state)
        actions = ", ".join(f"{item.name} [{item.unit}]" for item in self.system.action)
        bases = ", ".join(f"{kind} ({name})" for name, kind in self.kinds.items())
        unused = [f"not used: {', '.join(map(printable, self.unused))}"] if self.unused else []
        error = (
            f"error on the last part of the log after {self.horizon:g} s: {self.error:.3g} of the usual change; "
            f"constant velocity {self.naive:.3g}"
        )
        if not self.error < self.naive:
            error += (
                "\nno proposed base predicts better than constant velocity: the log may lack a command that moves the "
                "robot, or its physics is none of these; name columns with --state and --action, or edit robot.py"
            )
        checked = f"check names, units and bounds in {self.folder / 'robot.py'}, then:"
        return "\n".join(
            [f"states: {states}", f"actions: {actions}", f"base: {bases}", *unused, error, checked, f"  {self.command}"]
        )

    def _facts(self) -> dict[str, object]:
        return {"robot": self.system.name, "bases": self.kinds, "error": f"{self.error:.3g}", "folder": self.folder}

    def _columns(self) -> dict[str, Sequence[Any]]:
        roles = {"state": self.system.state, "action": self.system.action}
        rows = [(role, item) for role, items in roles.items() for item in items]
        table: dict[str, Sequence[Any]] = {"role": [role for role, _ in rows]}
        return table | {name: [getattr(item, name) for _, item in rows] for name in ("name", "unit", "low", "high")}


def init(
    log: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    states: Mapping[str, str] | None = None,
    actions: Mapping[str, str] | None = None,
    base: str | None = None,
    robot: str | None = None,
    horizon: float | None = None,
    force: bool = False,
) -> StartedModel:
    """Writes a first model of a robot from logs of it: robot.py, model.toml and columns.toml in the folder ``out``.

    The logs are one or several tables (CSV, Parquet, arrays) with the same columns. Without ``states`` and ``actions``
    (columns by name) the columns are recognised: a rate is the slope of another column; a command has the name of one
    or is constant between jumps. The base is the one with the smallest error on the last part of each log among those
    that the columns allow, or that of the kind ``base``. ``robot`` is the name of the robot, by default that of the
    folder; ``horizon`` [s] how far ahead the error is. The proposal has to be checked. Raises InputError for unknown
    columns or kinds, for named states that no base moves by the actions, and if no state or no command is found,
    RunError for an unusable log.

    Example:

        >>> safedpa.init("degrees.csv", "my_pendulum", actions={"torque": "torque"}).system.action_names
        ('torque',)
    """
    need("diagnosis", what="init()")
    paths = [Path(log)] if isinstance(log, (str, Path)) else [Path(item) for item in log]
    folder = Path(out)
    if not paths:
        raise InputError("log: got none; wanted a log of a robot")
    if base is not None and base not in KINDS:
        raise InputError(f"base: got '{base}'; {did_you_mean(base, KINDS)}")
    name = _identifier(robot or folder.resolve().name)
    if name in systems():
        raise InputError(f"robot: '{name}' is known already; choose another name with --robot")
    files = [folder / file for file in ("robot.py", "model.toml", "columns.toml")]
    refuse_inputs(files, paths, False)
    existing = [str(file) for file in files if file.exists()]
    if existing and not force:
        raise InputError(f"{existing[0]}: exists and may have your changes; choose another folder, or use --force")
    table = RecognisedColumns.of(paths, states or {}, actions or {})
    started = _Proposal(paths, name, table, horizon)
    with progress("comparing bases") as report_progress:
        report_progress(0, 1)
        found = started.chosen(base)
        report_progress(1, 1)
    system = found.model.system
    _require_states(system, states or {}, actions or {})
    require_writable_folder(folder, create=True)
    for file, text in zip(files, (found.source, write_model(found.model), started.map_text(system)), strict=True):
        file.write_text(text, encoding="utf-8")
    used = {
        item.source
        for item in (*table.states, *table.actions)
        if item.name in (*system.state_names, *system.action_names)
    }
    unused = tuple(column for column in table.names if column not in used | {table.time})
    return StartedModel(folder, tuple(paths), system, found.kinds, found.error, found.naive, started.horizon, unused)


def _require_states(system: System, states: Mapping[str, str], actions: Mapping[str, str]) -> None:
    """Refuses to leave out a state that the user named."""
    if lost := [given for given in states if given not in system.state_names]:
        raise InputError(
            f"state: no base moves {', '.join(lost)} by {', '.join(actions or system.action_names)}; "
            "leave them out, or name what moves them as an action"
        )


def _identifier(name: str) -> str:
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "robot"
    return plain if plain[0].isalpha() else f"robot_{plain}"


@dataclass(frozen=True)
class _Fit:
    """A base, fitted: the model, its error on the last part of the log, robot.py, and the kinds by state."""

    proposed: ProposedBase
    model: PhysicsModel
    error: float
    naive: float
    """That of constant velocity."""
    source: str
    kinds: dict[str, str]
    by_state: Mapping[str, float]
    """Error of each state that is not a rate."""


class _Proposal:
    """Compares bases for the columns of a log."""

    def __init__(self, logs: Sequence[Path], robot: str, columns: RecognisedColumns, horizon: float | None) -> None:
        self.logs, self.robot, self.columns = logs, robot, columns
        measured = float(np.median(np.diff(columns.t)))
        self.period = float(f"{max(measured, _LEAST_PERIOD):.4g}")
        self.thinned = measured < 0.7 * _LEAST_PERIOD
        each = float(columns.t[-1] - columns.t[0]) / len(logs)
        longest = _OF_REST * (1.0 - _TRAINING) * each  # of short logs the last part has to hold some windows
        self.horizon = horizon or float(f"{min(max(1.0, 20.0 * self.period), max(longest, 6.0 * self.period)):.3g}")
        self.reasons: list[str] = []
        pairs = rate_pairs(columns.t, columns.states)
        known = {item.name: item for item in columns.states}
        self.pairs = {position: rate for position, rate in pairs.items() if position in known and rate in known}
        self.quantities = {item.name: item for item in (*columns.states, *columns.actions)}
        if any(item.si in ("A", "N m") for item in columns.actions):  # a motor that turns something
            for item in columns.states:
                if "pos" in item.name and item.si == "m":
                    self.quantities[item.name] = item.with_si("rad")
        for position, rate in self.pairs.items():
            si = self.quantities[position].si
            self.quantities[rate] = self.quantities[rate].with_si(f"{si}/s")
        self.derived: dict[str, str] = {}
        self.actions = tuple(self._variable(item.name, command=True) for item in columns.actions)

    def chosen(self, base: str | None) -> _Fit:
        """The base with the smallest error on the last part of the log."""
        planar = self._planar() if base in (None, "planar") else None
        if planar is not None:
            return planar
        whole = self._whole(base)
        if base in WHOLE:
            if whole is None:
                raise InputError(f"base: {base} needs other states or actions: {WHOLE[base]}")
            return whole
        coupled = self._coupled() if base in (None, "coupled") else None
        chains = self._chains(base)
        best = whole
        if chains:
            best = chains[0] if len(chains) == 1 else self._fitted(_joined([one.proposed for one in chains]))
            best = replace(best, kinds={head: kind for one in chains for head, kind in one.kinds.items()})
            best = best if whole is None or best.error < whole.error else whole
        if coupled is not None and (best is None or _explains_more(coupled, best)):
            return coupled
        if best is None:
            why = f" ({self.reasons[-1]})" if self.reasons else ""
            raise InputError(f"{self.logs[0]}: no base fits the columns{why}; name them with --state and --action")
        return best

    def _coupled(self) -> _Fit | None:
        """States that drive each other, with the coefficients that unseen rows need; None for a single state."""
        measured = self._measured()
        if not 1 < len([name for name in measured if name not in self.pairs.values()]) <= _MOST_COUPLED:
            return None
        system = System(self.robot, tuple(map(self._variable, measured)), self.actions)
        full = coupled_base(system, {name: rate for name, rate in self.pairs.items() if name in measured})
        try:
            training, rest = self._runs(system)
            parts = [list(chain.from_iterable(run.parts() for run in runs)) for runs in (training, rest)]
            return self._best([needed_terms(full, base_of(self._source(system, full)), *parts)])
        except SafedpaError as error:
            self.reasons.append(f"coupled: {error}")
            return None

    def _planar(self) -> _Fit | None:
        """A body on a plane: known kinematics, and a base for each velocity in its frame; None for other logs."""
        motion = planar_motion(self.columns.t, [self.quantities[name] for name in self._measured()])
        turn = "" if motion is None else self.pairs.get(motion.yaw, "")
        if motion is None or not turn:
            return None
        parts = []
        for name in filter(None, (motion.forward, motion.lateral, turn)):
            chains = [replace(one, prefix=f"{name}_") for one in self._chain(name, several=True)[:1]]
            parts.append(self._best([option for one in chains for option in bases_of_chain(one)]))
            if parts[-1] is None:
                return None
        chosen = [one.proposed for one in parts if one is not None]
        turning = [
            option for one in self._chain(turn, several=True)[:1] for option in turning_base(one, motion.forward)
        ]
        options = [
            ProposedBase("planar", {**planar_rates(motion, turn), **_joined(bases).rates})
            for bases in (chosen, *([*chosen[:-1], option] for option in turning))
        ]
        return self._best(options)

    def _whole(self, base: str | None) -> _Fit | None:
        system = System(self.robot, tuple(map(self._variable, self._measured())), self.actions)
        options = [one for one in whole_robot(system) if base in (None, one.kind)]
        return self._best(options)

    def _best(self, options: Sequence[ProposedBase]) -> _Fit | None:
        best: _Fit | None = None
        for option in options:
            try:
                found = self._fitted(option)
            except SafedpaError as error:  # a base that cannot be fitted to this log
                self.reasons.append(f"{option.kind}: {error}")
                continue
            if best is None or found.error < _CLEARLY * best.error:
                best = found
        return best

    def _measured(self) -> list[str]:
        return [item.name for item in self.columns.states]

    def _chains(self, base: str | None) -> list[_Fit]:
        heads = [name for name in self._measured() if name not in self.pairs.values()]
        found = []
        for head in heads:
            options = chain.from_iterable(bases_of_chain(one) for one in self._chain(head, len(heads) > 1))
            found.append(self._best([one for one in options if base in (None, one.kind)]))
        fitted = [one for one in found if one is not None]
        # a state predicted worse than by no change is not driven by these commands, such as x by a steering angle alone
        return [one for one in fitted if one.error < 1.0] or fitted

    def _chain(self, name: str, several: bool) -> list[StateChain]:
        """The state with its measured rate; without one alone, and with its slope."""
        commands = self._commands_of(name)
        if not commands:
            return []
        position, values = self._variable(name), self.quantities[name].values
        given = [self.quantities[item.name] for item in commands]
        alike = [item for item in given if item.si in ("1", position.unit) or position.unit == "1"]
        copied = [item.name for item in alike if COMMANDED.search(item.source) or follows(values, item.values)]
        for command in copied[:1]:
            self.quantities[command] = self.quantities[command].with_si(position.unit)
        self.actions = tuple(self._variable(item.name, command=True) for item in self.columns.actions)
        prefix = f"{name}_" if several else ""
        one = StateChain(position, None, commands, copied[0] if copied else "", prefix)
        if name in self.pairs:
            return [replace(one, rate=self._variable(self.pairs[name]))]
        if position.unit.endswith("/s"):
            return [one]
        rate = f"{name}_rate"
        self.derived[rate] = name
        return [one, replace(one, rate=self._variable(rate))]

    def _commands_of(self, name: str) -> tuple[Variable, ...]:
        """The commands without which the changes of a state, or of its rate, are explained worse."""
        t, values = self.columns.t, self.quantities[name].values
        rate = self.quantities[self.pairs[name]].values if name in self.pairs else np.gradient(values, t)
        used = []
        for command in self.actions:
            others = [self.quantities[item.name].values for item in self.actions if item is not command]
            for changed, known in ((values, [values]), (rate, [values, rate])):
                rest = [unexplained_change(t, changed, [*known, *others])]
                rest.append(unexplained_change(t, changed, [*known, *others, self.quantities[command.name].values]))
                if rest[1] < (1.0 - _DRIVEN) * rest[0]:
                    used.append(command)
                    break
        # A robot with one command has to be moved by it, however little of the log shows that.
        return tuple(used) or (self.actions if len(self.actions) == 1 else ())

    def _fitted(self, proposed: ProposedBase) -> _Fit:
        """The base, fitted to the first part of the log, and its error on the rest: of positions, if there are any."""
        system = System(self.robot, tuple(map(self._variable, proposed.rates)), self._driving(proposed))
        training, rest = self._runs(system)
        stretches = list(chain.from_iterable(run.parts() for run in training))
        values = fitted_start(base_of(self._source(system, proposed)), stretches)
        terms = [term for rate in proposed.rates.values() for term in rate]
        if not values or any(values[term.parameter] <= 0.0 for term in terms if term.positive):
            raise RunError(f"{self.logs[0]}: {proposed.kind} does not fit")
        rounded = {name: float(f"{value:.4g}") for name, value in values.items()}
        source = self._source(system, replace(proposed, values=rounded))
        made = base_of(source)
        settings = {f"base.{item.name}": Setting(item.start, free=True) for item in made.parameters}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # predictions of an unsuitable base may diverge
            model = refit(PhysicsModel(made, (), settings, self.period), training, horizon=self.horizon).model
            errors = compare_model(model, rest, self.horizon).horizons[-1].errors
            per_state, naive = errors["model"].per_state, errors["constant_velocity"].per_state
        later = [*self.derived, *(rate for name, rate in self.pairs.items() if name in system.state_names)]
        heads = [at for at, state in enumerate(system.state_names) if state not in later]
        kinds = {system.state_names[heads[0]]: proposed.kind}
        if not np.isfinite(per_state[heads]).any():
            raise RunError(f"{self.logs[0]}: {proposed.kind} diverges")
        error, of_naive = (float(np.nanmean(found[heads])) for found in (per_state, naive))
        by_state = {system.state_names[at]: float(per_state[at]) for at in heads}
        return _Fit(proposed, model, error, of_naive, source, kinds, by_state)

    def _runs(self, system: System) -> tuple[list[Run], list[Run]]:
        """The first and the last part of each log."""
        mapping = parse_column_map(self.map_text(system), self.logs[0].stem)
        parts = [_parts(read_log(log, system, mapping)) for log in self.logs]
        training, rest = ([run for run in runs if run.stretches] for runs in zip(*parts, strict=True))
        return training, rest

    def _driving(self, proposed: ProposedBase) -> tuple[Variable, ...]:
        text = " ".join(term.expression for terms in proposed.rates.values() for term in terms)
        return tuple(item for item in self.actions if f'action["{item.name}"]' in text)

    def _source(self, system: System, proposed: ProposedBase) -> str:
        sizes = {name: self._size(name) for name in moving(proposed)}
        return proposed.source(system, sizes, printable(self.logs[0].name, but='"\\'))

    def _size(self, name: str) -> float:
        return float(np.quantile(np.abs(self._values(name)), 0.9)) or 1.0

    def _values(self, name: str) -> FloatArray:
        if name not in self.derived:
            return self.quantities[name].values
        t, values = self.columns.t, self.quantities[self.derived[name]].values
        slopes = changes(t, values, _DERIVED_ROWS)[0] / changes(t, np.ones_like(t), _DERIVED_ROWS)[1]
        return np.asarray(slopes, dtype=np.float64)

    def _variable(self, name: str, command: bool = False) -> Variable:
        values = self._values(name)
        low, high = float(values.min()), float(values.max())
        space = (0.01 if command else 2.0) * (high - low)
        digit = 10.0 ** np.floor(np.log10(0.1 * (high - low)))  # rounded outwards: no row of the log is beyond
        low = round(float(np.floor((low - space) / digit) * digit), 12)
        high = round(float(np.ceil((high + space) / digit) * digit), 12)
        if name in self.derived:
            return Variable(name, f"{self.quantities[self.derived[name]].si}/s", low, high)
        wraps = not command and bool(np.any(np.abs(np.diff(values)) > np.pi)) and self.quantities[name].si == "rad"
        return Variable(name, self.quantities[name].si, low, high, wraps)

    def map_text(self, system: System) -> str:
        """The column map for the states and actions of a system, as TOML."""
        lines = [QuantityForm("t", "s", self.columns.time, self.columns.time_unit)]
        for item in (*system.state, *system.action):
            if item.name not in self.derived:
                found = self.quantities[item.name]
                lines.append(QuantityForm(item.name, found.si, found.source, found.unit))
        text = map_text(system, lines)
        window = float(f"{_DERIVED_ROWS * self.period:.3g}")
        for name in (state for state in system.state_names if state in self.derived):
            text += f'{name} = {{ derive = "slope", of = "{self.derived[name]}", window = {window!r} }}\n'
        return text.replace("\n\n", f"\nkeep_period = {self.period!r}\n\n", 1) if self.thinned else text


def _parts(run: Run) -> tuple[Run, Run]:
    """The first and the last part of a run."""
    at = int(_TRAINING * len(run.t))
    first = tuple(Stretch(part.start, min(part.stop, at)) for part in run.stretches if part.start < at)
    last = tuple(Stretch(max(part.start, at), part.stop) for part in run.stretches if part.stop > at)
    return replace(run, stretches=first), replace(run, stretches=last)


def _explains_more(coupled: _Fit, best: _Fit) -> bool:
    """Whether a coupled base predicts the states of a simpler one clearly better, or as well and further states too."""
    if not set(best.by_state) <= set(coupled.by_state):
        return False
    own = float(np.mean([coupled.by_state[name] for name in best.by_state]))
    further = [error for name, error in coupled.by_state.items() if name not in best.by_state]
    as_good = bool(further) and max(further) < _FURTHER and own < best.error / _CLEARLY
    return own < _CLEARLY * best.error or as_good


def _joined(bases: Sequence[ProposedBase]) -> ProposedBase:
    """One base of several, whose states do not act on each other."""
    rates = {name: terms for base in bases for name, terms in base.rates.items()}
    return ProposedBase("_and_".join(dict.fromkeys(base.kind for base in bases)), rates)
