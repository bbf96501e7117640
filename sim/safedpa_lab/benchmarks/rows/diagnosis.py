"""Diagnosis of six runs of forty seconds, next to programs that look for terms of equations; of a real car, too."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa.records.run import Run
from safedpa_lab.benchmarks.peer_process import ask_peer
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target, missing

NAMES: Final = ("speed", "target", "steer", "sign")
"""What a peer may use: the speed, both commands, and the sign of the speed."""


@final
@dataclass(frozen=True)
class Hidden:
    """What is hidden, and which terms of the speed's and the yaw's derivative say so; any of the sets will do."""

    name: str
    effects: Mapping[str, Mapping[str, float]]
    push: tuple[frozenset[str], ...] = (frozenset(),)
    turn: tuple[frozenset[str], ...] = (frozenset(),)
    turn_further: tuple[frozenset[str], ...] = ()
    """Variables that an expression for the yaw may name as well: tan(steer + offset) is no polynomial."""


def _any(*sets: str) -> tuple[frozenset[str], ...]:
    return tuple(frozenset(names.split(", ")) for names in sets)


_DRAG, _OFFSET = _any("speed sign", "speed^2", "speed^2, speed sign"), _any("speed")
_BOTH = _any("speed, steer")
_RESISTANCE = _any("sign", "1, sign")
CASES: Final = (
    Hidden("nothing", {}),
    Hidden("quadratic drag", {"quadratic_drag": {"coefficient": 0.12}}, push=_DRAG),
    Hidden("viscous drag", {"viscous_drag": {"coefficient": 0.3}}, push=_any("speed")),
    Hidden("rolling resistance", {"rolling_resistance": {"deceleration": 0.45}}, push=_RESISTANCE),
    Hidden("payload", {"payload": {"mass_ratio": 0.3}}, push=_any("speed, target")),
    Hidden("steering offset", {"steering_offset": {"angle": 0.04}}, turn=_OFFSET, turn_further=_BOTH),
    Hidden("steering gain", {"steering_gain": {"gain": 0.85}}, turn=_any("speed steer")),
    Hidden(
        "drag and offset",
        {"quadratic_drag": {"coefficient": 0.12}, "steering_offset": {"angle": 0.04}},
        push=_DRAG,
        turn=_OFFSET,
        turn_further=_BOTH,
    ),
    Hidden(
        "resistance and offset",
        {"rolling_resistance": {"deceleration": 0.45}, "steering_offset": {"angle": 0.04}},
        push=_RESISTANCE,
        turn=_OFFSET,
        turn_further=_BOTH,
    ),
)
"""Effects of ordinary strength that a polynomial of the variables can say; two of the cases hide a pair."""


def written(hidden: Hidden, folder: Path, runs: int, seconds: float) -> Any:
    """Simulates and writes one case; where it lies."""
    from safedpa_lab.hidden.case import Case
    from safedpa_lab.hidden.write import write_case

    case = Case("benchmark", 7, dict(hidden.effects), runs=runs, seconds=seconds)
    return write_case(case, folder)


def reported(log: Any) -> dict[str, Any]:
    """What a peer is given of a case: per run what the given model leaves of yaw and speed, and the variables."""
    model = load_model(log.model)
    described = [_left_over(model, load_run(path, model.system)) for path in log.runs]
    return {
        "period": model.period,
        "names": list(NAMES),
        "runs": [
            {"rests": rests.tolist(), "slopes": (steps / model.period).tolist(), "middle": middle.tolist()}
            for rests, steps, middle in described
        ],
    }


def _left_over(model: PhysicsModel, run: Run) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What one period's steps of yaw and speed have beyond the model's (n, 2), their sums, the variables (n, 4).

    The model's rates are averaged over both ends of a period, with the command that was held in between.
    """
    base = {path.split(".")[1]: setting.value for path, setting in model.settings.items()}
    limit, commands = base["acceleration_limit"], run.actions[:-1]
    target, steer = commands.T
    speed, yaw = run.states[:, 3], np.unwrap(run.states[:, 2])
    ends = (speed[:-1], speed[1:])
    push = sum(0.5 * np.clip(base["speed_gain"] * (target - end), -limit, limit) for end in ends)
    middle = 0.5 * (ends[0] + ends[1])
    turn = middle * np.tan(steer) / base["wheelbase"]
    steps = np.stack([np.diff(yaw) - model.period * turn, np.diff(speed) - model.period * push], axis=1)
    rests = np.cumsum(steps, axis=0) - 0.5 * steps
    return rests, steps, np.stack([middle, target, steer, np.tanh(middle / 0.02)], axis=1)


def terms_are_right(hidden: Hidden, equations: Sequence[Mapping[str, float]]) -> bool:
    """Whether the equations of yaw and speed hold exactly the terms that are hidden."""
    turn, push = (frozenset(equation) for equation in equations)
    return turn in hidden.turn and push in hidden.push


def expression_is_right(hidden: Hidden, variables: Sequence[Sequence[str]]) -> bool:
    """Milder: whether the expressions for yaw and speed name the right variables, whatever they do with them."""
    turn, push = (frozenset(names) for names in variables)
    return turn in (*_variables(hidden.turn), *hidden.turn_further) and push in _variables(hidden.push)


def _variables(wanted: Sequence[frozenset[str]]) -> list[frozenset[str]]:
    return [frozenset(" ".join(terms).replace("^2", "").split()) - {"1"} for terms in wanted]


_NAME: Final = "safedpa, DART drives"
_PROBLEM: Final = "four drives of a real car"
_DRIVES: Final = 4
_HORIZON: Final = 1.0
"""s, as the experiment on real logs has it."""
_MOST_SECONDS: Final = 30.0


def dart_drives(effort: Effort) -> tuple[Entry, list[Target]]:
    """Seconds from the files to the report, by the clock and of the processor, and the target; or why there are none.

    Raises InputError where the named folder does not hold the four drives.
    """
    if effort.recordings is None:
        return missing(
            _NAME, "left out: --data DIR names the folder of the drives; see docs/evidence/diagnosis.md", _PROBLEM
        ), []
    paths = _found(effort.recordings)
    if effort.quick:
        return missing(_NAME, "left out of a quick run", _PROBLEM), []
    entry = _diagnosed(paths)
    target = Target("DART drives, seconds of processor", _MOST_SECONDS, entry.processor["seconds"], "s")
    return entry, [target]


def _found(folder: Path) -> list[Path]:
    from safedpa_lab.experiments.diagnosis.real_logs_data import CAR, paths_of

    paths = paths_of(folder, CAR)
    if len(paths) != _DRIVES:
        raise InputError(
            f"--data {folder}: got {len(paths)} files {CAR}, wanted {_DRIVES}; see docs/evidence/diagnosis.md"
        )
    return paths


def _diagnosed(paths: list[Path]) -> Entry:
    from safedpa.diagnosis.diagnose import diagnose
    from safedpa.diagnosis.report_schema import as_document
    from safedpa.dynamics import load_model
    from safedpa_lab.experiments.diagnosis.real_logs_data import mapped_runs

    began, before = time.perf_counter(), time.process_time()
    model = load_model("dart_car")
    runs = mapped_runs(paths, model, "dart_car_columns")
    document = as_document(diagnose(model, runs, _HORIZON))
    seconds, used = time.perf_counter() - began, time.process_time() - before
    driven = sum(float(run.t[-1] - run.t[0]) for run in runs)
    note = f"{len(runs)} drives, {driven:.0f} s together, all from files to report"
    figures, processor = {"seconds": seconds, "longest": seconds}, {"seconds": used, "longest": used}
    return Entry(_NAME, figures, "s", processor, _PROBLEM, note, more={"verdict": document.get("verdict")})


_RUNS, _SECONDS = 6, 40.0
_LACKS = "given what the model leaves of each step; no memory of actuators, nothing held out, no verdict"
_THRESHOLDS: Final = {"polynomial": 0.05, "weak": 0.05}
"""Below it a coefficient is dropped: half of the weakest term that is hidden."""


def measure(effort: Effort) -> Row:
    """Cases with one hidden effect, two, or none: seconds of each and how many answers are right."""
    runs, seconds = effort.of((2, 20.0), (_RUNS, _SECONDS))
    cases = CASES[1:2] if effort.quick else CASES
    with tempfile.TemporaryDirectory(prefix="safedpa-bench-") as name:
        logs = [written(case, Path(name) / str(number), runs, seconds) for number, case in enumerate(cases)]
        own, candidates = _ours(cases, logs)
        offered = _offered(logs[0])
        peers = _peers(cases, [reported(log) for log in logs], effort)
        curves = (_over_length(Path(name), effort), _over_effects(logs[-1], effort))
    real, real_targets = dart_drives(effort)
    targets = (
        Target("the longest of the cases", 10.0, own.figures["longest"], "s"),
        Target("the cases on average", 5.0, own.figures["seconds"], "s"),
        *real_targets,
    )
    work = f"diagnosis of {runs} runs of {seconds:g} s, {candidates} candidates and their pairs, {len(cases)} cases"
    notes = (f"hidden: {', '.join(case.name for case in cases)}", offered)
    return Row("diagnosis", work, "seconds", (own, real), tuple(peers), targets, curves, notes=notes)


def _offered(log: Any) -> str:
    """Which candidates there are: the library of cars without what the given model's actions do not allow."""
    from safedpa.diagnosis.diagnose import library_for
    from safedpa.dynamics import load_model
    from safedpa.effects import effects_of

    model = load_model(log.model)
    every, offered = effects_of(model.system.name), {item.name for item in library_for(model)}
    left_out = ", ".join(name for name in every if name not in offered)
    return f"candidates: {len(offered)} of the library's {len(every)} effects; not for this drive: {left_out or 'none'}"


def _ours(cases: Sequence[Hidden], logs: Sequence[Any]) -> tuple[Entry, int]:
    from safedpa.diagnosis.diagnose import library_for
    from safedpa.dynamics import load_model
    from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed
    from safedpa_lab.hidden.case import truth_of
    from safedpa_lab.hidden.judge import judged

    clock: list[float] = []
    used: list[float] = []
    right = []
    for hidden, log in zip(cases, logs, strict=True):
        began, before = time.perf_counter(), time.process_time()
        document = diagnosed(log.model, log.runs)
        clock.append(time.perf_counter() - began)
        used.append(time.process_time() - before)
        outcome = judged(hidden.name, document, truth_of(log.case), None, clock[-1])
        right.append(outcome.right and not outcome.wrong)
    named = [case.name for case, good in zip(cases, right, strict=True) if not good]
    note = "reads the files, searches, fits, judges" + (f"; not right: {', '.join(named)}" if named else "")
    return _entry("safedpa", clock, used, right, note), len(library_for(load_model(logs[0].model)))


def _entry(
    name: str, clock: Sequence[float], used: Sequence[float], right: Sequence[bool], note: str, **more: Any
) -> Entry:
    figures = {"seconds": sum(clock) / len(clock), "longest": max(clock), "right": float(sum(right))}
    processor = {"seconds": sum(used) / len(used), "longest": max(used)}
    return Entry(name, figures, "s", processor, note=note, more={"cases": len(right), **more})


def _peers(cases: Sequence[Hidden], questions: list[dict[str, Any]], effort: Effort) -> list[Entry]:
    found = []
    for way, name in (("weak", "pysindy, weak form"), ("polynomial", "pysindy, polynomial")):
        question = {"way": way, "threshold": _THRESHOLDS[way], "cases": questions}
        answer = ask_peer("diagnosis:pysindy", "pysindy", question, effort.interpreters, 600.0)
        found.append(_peer(name, answer, cases, way))
    question = {"seconds": effort.of(1, 3), "cases": questions}
    answer = ask_peer("diagnosis:operon", "pyoperon", question, effort.interpreters, 600.0)
    found.append(_peer("pyoperon", answer, cases, "expression"))
    return found


def _peer(name: str, reply: dict[str, Any], cases: Sequence[Hidden], way: str) -> Entry:
    if "missing" in reply:
        return missing(name, reply["missing"], note=_LACKS)
    answers = reply["answers"]
    if way == "expression":
        right = [
            expression_is_right(case, [equation["variables"] for equation in answer["equations"]])
            for case, answer in zip(cases, answers, strict=True)
        ]
        note = "as long as it is given; right if its expressions name the right variables alone; "
    else:
        right = [terms_are_right(case, answer["equations"]) for case, answer in zip(cases, answers, strict=True)]
        note = f"{answers[0]['terms']} terms of degree 2 in 4 variables; right if exactly the hidden terms stay; "
    clock, used = ([answer[key] for answer in answers] for key in ("seconds", "processor_seconds"))
    notice = {case.name: answer["equations"] for case, answer in zip(cases, answers, strict=True)}
    return _entry(name, clock, used, right, note + _LACKS, version=reply["version"], notice=notice)


def _over_length(folder: Path, effort: Effort) -> Curve:
    """Seconds of our diagnosis over the length of each run."""
    from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed

    lengths, times = effort.of((5.0, 10.0), (10.0, 20.0, 40.0, 80.0, 160.0)), []
    for length in lengths:
        log = written(CASES[1], folder / f"long {length:g}", effort.of(2, _RUNS), length)
        began = time.process_time()
        diagnosed(log.model, log.runs)
        times.append(time.process_time() - began)
    series: dict[str, tuple[float | None, ...]] = {"safedpa": tuple(times)}
    return Curve("diagnosis_length", "s of each run", "diagnosis [s of processor]", tuple(lengths), series)


def _over_effects(log: Any, effort: Effort) -> Curve:
    """Seconds of our search over the number of candidates in the library."""
    from safedpa.diagnosis.diagnose import library_for
    from safedpa.diagnosis.fit.data_checks import data_at_horizon, prepare_runs
    from safedpa.diagnosis.search.forward_selection import run_search
    from safedpa.dynamics import load_model
    from safedpa.records import load_run

    model = load_model(log.model)
    usable = prepare_runs(model, [load_run(path, model.system) for path in log.runs])
    evidence = data_at_horizon(usable.runs, usable.seconds)
    hidden = set(log.case.effects)
    library = sorted(library_for(model), key=lambda item: item.name not in hidden)
    counts, times = effort.of((2, 4), (2, 6, 12, len(library))), []
    for count in counts:
        began = time.process_time()
        run_search(model, library[:count], evidence.shooting, evidence.heldout)
        times.append(time.process_time() - began)
    series: dict[str, tuple[float | None, ...]] = {"safedpa": tuple(times)}
    return Curve("diagnosis_effects", "candidate effects", "search [s of processor]", tuple(map(float, counts)), series)
