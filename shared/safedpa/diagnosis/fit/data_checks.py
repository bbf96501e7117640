"""Checks whether recordings allow a verdict about physics, and prepares what the diagnosis uses of them.

The horizon is the number of seconds over which predictions are compared with data to decide what a model lacks. The
data determine it, not the user. In a long window an effect grows above the noise. In a window that is too long the
error of the start dominates (a pendulum near upright), or too few independent windows remain. So the longest of a fixed
series of horizons is taken in which errors of the start stay small and of which the recordings hold enough windows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.excerpt import first_seconds, subsample_runs, without_duplicates
from safedpa.comparison.rollout import check_system, rollout_at
from safedpa.comparison.rollout_error import change_scale
from safedpa.comparison.windows import check_runs, windows_of
from safedpa.diagnosis.fit.clock_drift import clock_drifts
from safedpa.diagnosis.fit.cross_validation import Heldout, heldout_of
from safedpa.diagnosis.fit.multiple_shooting import Shooting, shooting_of, simulate
from safedpa.diagnosis.fit.recalibrated_states import recalibrated_states
from safedpa.dynamics import PhysicsModel
from safedpa.errors import RunError
from safedpa.records.run import Finding, Run

LONGEST = 1.0
"""Longest horizon [s], unless 20 rows last longer."""
# At low rates a second holds too few rows to separate a rate from noise.
_LONGEST_ROWS = 20
# Each horizon is about 0.7 of the one before: close enough that no usable length is missed by much.
_SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12)
# The start takes one unknown per state, so fewer rows leave nothing to fit a parameter to.
_MIN_ROWS = 6
# Twice FEWEST_WINDOWS: a shorter horizon is preferred to a verdict from few independent windows.
_ENOUGH_WINDOWS = 20
FEWEST_WINDOWS = 10
FEWEST_SECONDS = 5.0
"""Below either of these no effect is judged."""
# Bound on the growth of an error of the start, in units of each state's usual change. A pendulum near upright grows by
# exp(4.4 t), which gives 0.4 s.
_MAX_GROWTH = 8.0
# A 90 % quantile over 120 windows is precise enough to choose between horizons.
_SAMPLED_WINDOWS = 120
# Large enough for differences in double precision, small enough to stay linear.
_DIFFERENCE = 1e-4
# Enough for the sign of an answer, few enough to take no time.
_JUDGED_WINDOWS = 400


@dataclass(frozen=True)
class HorizonData:
    """The same recordings at one horizon: windows for the fit and windows for the held-out error."""

    seconds: float
    shooting: Shooting
    heldout: Heldout

    def with_commands(self, *, between_rows: bool) -> HorizonData:
        """Returns both with commands that change at the rows that show them, or half a period before."""
        heldout = self.heldout.with_commands(between_rows=between_rows)
        return HorizonData(self.seconds, self.shooting.with_commands(between_rows=between_rows), heldout)


def data_at_horizon(runs: Sequence[Run], seconds: float) -> HorizonData:
    """Returns windows of ``seconds``; raises InputError and RunError as ``windows_of`` does."""
    return HorizonData(seconds, shooting_of(runs, seconds), heldout_of(runs, seconds))


def data_at_other_horizons(runs: Sequence[Run], seconds: float) -> Iterator[HorizonData]:
    """Yields the recordings at 0.5, 0.2 and 2 times the horizon, as far as they hold enough windows of it."""
    period = float(np.median([run.period for run in runs]))
    for share in (0.5, 0.2, 2.0):
        if share * seconds >= _MIN_ROWS * period and _count(runs, share * seconds) >= FEWEST_WINDOWS:
            yield data_at_horizon(runs, share * seconds)


def select_horizon(model: PhysicsModel, runs: Sequence[Run]) -> float:
    """Returns the horizon [s] on which the search decides for these runs, whatever horizon is displayed.

    If no horizon of the series has enough windows, the shortest is returned, which has most. Raises InputError for a
    model of another robot, RunError for unusable runs.
    """
    check_runs(runs)
    check_system(model.system, runs[0].system, runs[0].name)
    period = float(np.median([run.period for run in runs]))
    longest = max(LONGEST, _LONGEST_ROWS * period)
    horizons = [float(f"{share * longest:.3g}") for share in _SHARES if share * longest >= _MIN_ROWS * period]
    if not _count(runs, horizons[-1]):
        raise RunError(_too_short_message(runs, horizons[-1]))
    enough = [seconds for seconds in horizons[:-1] if _count(runs, seconds) >= _ENOUGH_WINDOWS]
    # The shortest horizon needs no growth check: there is nothing to fall back to.
    return next((seconds for seconds in enough if _growth(model, runs, seconds) <= _MAX_GROWTH), horizons[-1])


def _too_short_message(runs: Sequence[Run], seconds: float) -> str:
    lasts = max(float(t[-1] - t[0]) for run in runs for t, _, _ in run.parts() if len(t))
    return (
        f"{runs[0].name}: the longest stretch without a gap lasts {lasts:.4g} s, and effects are judged over "
        f"{seconds:g} s at least; record {recommended_recording(seconds)}"
    )


def recommended_recording(seconds: float) -> str:
    """Returns a text that says how long to record for windows of ``seconds``: the minimum, and a better value."""
    least = max(FEWEST_SECONDS, FEWEST_WINDOWS * seconds)
    return f"{least:.3g} s, better " + ("a minute" if least <= 30.0 else f"{2.0 * least:.3g} s")


def displayed_windows(runs: Sequence[Run], horizon: float, evidence: HorizonData) -> Heldout:
    """Returns windows of the displayed horizon; those of ``evidence`` if it is the same."""
    same = abs(horizon - evidence.seconds) < 1e-9
    return evidence.heldout if same else heldout_of(runs, horizon)


def _count(runs: Sequence[Run], seconds: float) -> int:
    """Returns how many windows of ``seconds`` fit one after the other without overlap."""
    return int(sum((t[-1] - t[0] + 0.5 * run.period) // seconds for run in runs for t, _, _ in run.parts() if len(t)))


def _growth(model: PhysicsModel, runs: Sequence[Run], seconds: float) -> float:
    """Returns the 90 % quantile of the growth of an error of the start, with states in units of their usual change."""
    every = windows_of(runs, seconds, every=seconds)
    windows = every.select(np.unique(np.linspace(0, len(every) - 1, _SAMPLED_WINDOWS).astype(np.int64)))
    scale = np.maximum(change_scale(every, every.end), 1e-9)
    starts = windows.states[windows.start]
    size = starts.shape[1]
    shifted = np.stack([starts, *(starts + _DIFFERENCE * scale * np.eye(size)[index] for index in range(size))])
    rows = np.array([0, int(windows.steps.min())])
    with np.errstate(all="ignore"):
        # Predictions may overflow where the model is unstable; those windows count as growing without bound below.
        ends = simulate([model] * (size + 1), windows, rows, shifted)[:, 1]
        columns = (ends[..., 1:] - ends[..., :1]) / (_DIFFERENCE * scale[:, None])
    finite = np.where(np.isfinite(columns), np.clip(columns, -1e6, 1e6), 1e6)
    # The spectral norm is the growth of the worst direction of the start's error.
    return float(np.quantile(np.linalg.norm(finite, ord=2, axis=(-2, -1)), 0.9))


MOST_ROWS = 40_000
"""Rows used at most; longer recordings are thinned to evenly spread pieces."""
# A wrong column, sign or unit looks like a missing effect and is larger than any real one, so no verdict is given.
_SEVERE = (
    "swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "steer_inconsistent", "time_offset",
    "changed_command", "clock_drift", "stale_command", "offset",
)  # fmt: skip
# Share of the rows out of bounds from which a run is no measurement of the robot that the system describes.
_MOST_OUTSIDE = 0.5
# Correlation and gain of the measured with the predicted answer to a command from which its sign is certainly wrong.
# Gains, lags and limits change the size of the answer, not its sign.
_OPPOSITE_CORRELATION, _OPPOSITE_GAIN = -0.6, -0.3
# Share of a state's motion that a command has to make by the model: less may be another effect by chance.
_OPPOSITE_SHARE = 0.2
# Shortest part of a run without coarse steps that is used by itself.
_LEAST_PART = 0.2


@dataclass(frozen=True)
class PreparedRuns:
    """The runs that are used, the findings about them, and the horizon [s] on which the search decides."""

    runs: list[Run]
    quality: list[dict[str, Any]]
    seconds: float


def prepare_runs(model: PhysicsModel, runs: Sequence[Run], most_rows: int = MOST_ROWS) -> PreparedRuns:
    """Returns the usable runs, each recording once, thinned to ``most_rows`` in evenly spread pieces.

    Raises InputError for a model of another robot, RunError for unusable runs.
    """
    quality = [finding_row(run.name, finding) for run in runs for finding in run.findings]
    # The same recording given twice would put copies on both sides of the cross-validation.
    once, repeated = without_duplicates(runs)
    quality += [finding_row(name, finding) for name, finding in repeated]
    fine = [_without_coarse_steps(run) for run in once]
    quality += [finding_row(run.name, item) for run, found in fine for item in found]
    once = [run for run, _ in fine]
    # The horizon comes before thinning: pieces have to be at least one window long.
    seconds = select_horizon(model, once)
    rows = sum(len(part) for run in once for part in run.stretches)
    used = subsample_runs(once, most_rows, seconds)
    if rows > most_rows:
        retained = sum(len(part) for run in used for part in run.stretches)
        message = f"of {rows} rows, {retained} in evenly spread pieces were used for fitting and judging"
        quality.append(finding_row("all", Finding("thinned", message, rows - retained)))
    for run in used:
        quality += [finding_row(run.name, item) for item in _constant_inputs(run)]
    # Not if a sign is known to be wrong in a part of a run: that part may be most of it.
    opposite = [] if _severe_finding(runs) else _opposite_answers(model, used, seconds)
    quality += [finding_row("all", item) for item in opposite]
    used = [replace(used[0], findings=(*used[0].findings, *opposite)), *used[1:]]
    # A wrong sign looks like a drift to a test that assumes the signs, and any other such fault may as well.
    for index, run in enumerate(used) if not _severe_finding(runs, used) else ():
        read = clock_drifts(model, run, seconds) or recalibrated_states(model, run, seconds)
        wrong = [item.accepted_in(run.keep) for item in read]
        quality += [finding_row(run.name, item) for item in wrong]
        used[index] = replace(run, findings=(*run.findings, *wrong))
    return PreparedRuns(used, quality, seconds)


def _without_coarse_steps(run: Run) -> tuple[Run, list[Finding]]:
    """Returns a run up to the row from which a state is read in coarse steps, which look like a changed sensor.

    A sensor that has such steps throughout is another matter: nothing changes, and there is no better part.
    """
    first = float(run.t[run.stretches[0].start])
    begins = [item.start_t for item in run.findings if item.kind == "quantised" and item.start_t is not None]
    begin = min((at for at in begins if at > first), default=None)
    if begin is None or "coarse_part" in run.keep:
        return run, []
    (before,) = first_seconds([run], begin - first - 0.5 * run.period)
    if before.duration < max(FEWEST_SECONDS, _LEAST_PART * run.duration):
        return run, []
    unused = sum(len(part) for part in run.stretches) - sum(len(part) for part in before.stretches)
    message = (
        f"{unused} rows from t = {begin:.3f} s on were not used, since a state has coarse steps there and not before; "
        'to use them, set keep = ["coarse_part"] in a column map'
    )
    return before, [Finding("coarse_part", message, unused, begin)]


def _opposite_answers(model: PhysicsModel, runs: Sequence[Run], seconds: float) -> list[Finding]:
    """Reports commands whose measured answers have the opposite sign of the predicted ones.

    The predicted answer to a command is what a prediction changes when the command replaces its mean. It is correlated
    with what is measured less the prediction with the mean.
    """
    every = windows_of(runs, seconds, every=seconds)
    windows = every.select(np.unique(np.linspace(0, len(every) - 1, _JUDGED_WINDOWS).astype(np.int64)))
    found, system = [], model.system
    with np.errstate(all="ignore"):
        given = rollout_at(model, windows, [windows.end])[0]
        for index, name in enumerate(system.action_names):
            actions = windows.actions.copy()
            actions[:, index] = actions[:, index].mean()
            without = rollout_at(model, replace(windows, actions=actions, memo={}), [windows.end])[0]
            answers = system.difference(given, without)
            measured = system.difference(windows.states[windows.end], without)
            state, correlation, gain = _most_opposite(answers, measured)
            if correlation < _OPPOSITE_CORRELATION and gain < _OPPOSITE_GAIN:
                text = (
                    f"{system.state_names[state]} answers to {name} with the opposite sign of the model (correlation "
                    f"{correlation:.2f}, {gain:.2g} times as much) throughout; nothing was cut; flip {name} in a "
                    "column map, or the sign of its gain in the model"
                )
                found.append(Finding("opposite_sign", text, len(windows), float(windows.t[0])))
    return found


def _most_opposite(answers: FloatArray, measured: FloatArray) -> tuple[int, float, float]:
    """Returns the state that moves most against its predicted answer, and correlation and gain of that motion.

    Every state counts of whose motion the command makes a part: the sign may matter to one of them and not to another,
    as the roll of a multirotor to the sideways speed and not to the lift. Means are left out, since a constant push
    changes them.
    """
    good = np.isfinite(answers).all(axis=1) & np.isfinite(measured).all(axis=1)
    if good.sum() < FEWEST_WINDOWS:
        return 0, 0.0, 0.0
    answers, measured = (part[good] - part[good].mean(axis=0) for part in (answers, measured))
    power, product = (answers**2).sum(axis=0), (answers * measured).sum(axis=0)
    total = (measured**2).sum(axis=0)
    counts = (power > 0.0) & (power >= _OPPOSITE_SHARE * total)
    correlation = np.where(counts, product / np.sqrt(np.maximum(power * total, 1e-300)), 0.0)
    state = int(np.argmin(correlation))
    return state, float(correlation[state]), float(product[state] / max(float(power[state]), 1e-300))


def _constant_inputs(run: Run) -> list[Finding]:
    """Reports inputs that never change: effects on them cannot be identified."""
    actions = np.concatenate([part for _, _, part in run.parts()])
    known = {finding.kind for finding in run.findings}
    if "constant_input" in known or not len(actions):
        return []
    # 1e-9 allows for rounding of a stored constant, in any unit.
    constant = [v.name for v, size in zip(run.system.action, np.ptp(actions, axis=0), strict=True) if size < 1e-9]
    message = f"{', '.join(constant)} never changes: effects on it cannot be distinguished from constants"
    return [Finding("constant_input", message, len(actions))] if constant else []


def finding_row(run: str, finding: Finding) -> dict[str, Any]:
    """Returns a finding as a row of the report."""
    return {"run": run, **vars(finding)}


@dataclass(frozen=True)
class DataSufficiency:
    """Whether the data allow a verdict about physics."""

    why_not: str
    """Empty if they do."""
    wrong: bool
    """Whether the data contradict their own description (columns, signs, units), rather than being too few."""

    @property
    def enough(self) -> bool:
        """Whether a verdict is possible."""
        return not self.why_not


def check_data_sufficiency(shooting: Shooting, used: Sequence[Run], runs: Sequence[Run]) -> DataSufficiency:
    """Decides whether the data allow a verdict about physics; ``used`` are the prepared ones of ``runs``."""
    # Wrong columns are reported first: more data of the same kind would not help.
    wrong = _severe_finding(runs, used)
    return DataSufficiency(wrong, True) if wrong else DataSufficiency(_insufficient_data(shooting, used), False)


def _insufficient_data(shooting: Shooting, runs: Sequence[Run]) -> str:
    """Returns why the data are too few to judge any effect; empty if they suffice."""
    seconds, each = sum(run.duration for run in runs), shooting.windows.horizon
    if len(shooting.windows) < FEWEST_WINDOWS or seconds < FEWEST_SECONDS:
        return (
            f"{seconds:.1f} s in {len(shooting.windows)} independent windows of {each:.3g} s are too little to judge "
            f"an effect; record at least {recommended_recording(each)}"
        )
    actions = np.concatenate([part for run in runs for _, _, part in run.parts()])
    if actions.shape[1] and (np.ptp(actions, axis=0) < 1e-9).all():
        return "no input ever changes: no effect can be identified from a constant; record a drive with steps in it"
    return ""


def _severe_finding(read: Sequence[Run], used: Sequence[Run] = ()) -> str:
    """Returns the first severe finding of runs as they were read, and of what is used of them; empty if none."""
    every = [(run, item) for run in (*read, *used) for item in run.findings]
    severe = [(run, item) for run, item in every if item.kind in _SEVERE]
    # A few rows beyond a bound are outliers; where most of them are, the unit is wrong, or the bound.
    outside = [
        (run, item)
        for run in read
        for item in run.findings
        if item.kind == "out_of_bounds" and item.count > _MOST_OUTSIDE * _rows_of_log(run)
    ]
    return next((f"{run.name}: {item.message}" for run, item in severe + outside), "")


def _rows_of_log(run: Run) -> int:
    """Rows of the log with those that were cut; not of a run that was thinned since."""
    return len(run.t) + sum(item.count for item in run.findings if item.kind == "cut")
