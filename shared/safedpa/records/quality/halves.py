"""Compares the parts of a log: does every action, state and clock mean the same from its beginning to its end?

Each check undoes a supposed fault (a sign reversed from some time on, a clock that drifts, an offset) and asks whether
one regression then explains the whole log clearly better. Physics that the regression lacks is not undone by that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.records.quality.findings import finding
from safedpa.records.quality.response import Response, Sums, response_of, without_worst
from safedpa.records.run import Finding, RawRows, Stretch
from safedpa.systems import System

__all__ = ["halves_findings"]

_PARTS = 24
"""Parts of a log between which a change is looked for."""
_FACTORS = (-1.0, 0.25, 0.5, 2.0, 4.0)
"""Factors of a command that are tried from some time on."""
_UNDONE = 0.5
"""Share of the unexplained changes of some state that may remain when a wrong factor is undone."""
_WORSE = 1.25
"""Share of the unexplained changes of any state above which a supposed fault contradicts that state."""
_UNDONE_USUAL = 0.75
"""The same without the windows that are explained worst."""
_VARIED = 0.5
"""Least standard deviation of a command in units of its mean."""
_OTHER_FACTOR = 0.6
"""The same for a factor that is no sign, as a share of that: physics changes size more easily than sign."""
_DRIFTS = (5.0, 14.0, 36.0)
"""Rows by which the end of a channel is tried to be later than its beginning, compared with the others."""
_FINER = (0.6, 0.75, 0.87, 1.15, 1.35, 1.6)
_DRIFTED, _DRIFTED_STATE = 0.12, 0.88
"""Least fall of the log of what is unexplained, summed over states, and what may remain of one state."""
_EACH_HALF = 0.25
"""Share of that fall that each half of the log has to show by itself."""
_SURE_DRIFT, _MEDIANS = 5.0, 9.0
"""Standard errors over the windows by which a drift of states has to explain more, with squares of at most so many
medians. Of logs without a drift the largest had 3, of logs with one the smallest 15."""
_OFFSETS = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Constant offsets that are tried with and without a drift, in parts of the drift."""
_CONFIRMED = 0.5
"""Share of that fall without the windows that are explained worst."""
_SHIFTED = 0.15
"""The same fall for an offset."""
_SHORT = 4
"""Rows of a window where single rows matter."""
_DONE = "nothing was cut; correct the column{where}, or set keep = [{kind}] in a column map if the robot itself changed"


def halves_findings(rows: RawRows, stretches: Sequence[Stretch], system: System) -> list[Finding]:
    """Findings about channels that change their meaning within a log: sign, factor, clock, offset, stale commands.

    The first kind that is found is reported: the later checks would see its consequences. A ``jump`` has to be cut at
    its time; for the others nothing is cut.
    """
    response = response_of(rows, stretches, system)
    short = response_of(rows, stretches, system, _SHORT)
    if response is None or short is None:
        return []
    # Impacts and emergency brakes are no faults of the data: without such windows a fault still has to show.
    usual = without_worst(response, _TRIMMED)
    found = _changed_command(response, usual) or _drift(response, usual)
    return found or _stale(short) or _offset(usual, short, usual.sums()[0])


_TRIMMED = 0.05
"""Share of the windows that are left out."""


def _done(kind: str, where: str = "") -> str:
    return _DONE.format(kind=f'"{kind}"', where=where)


def _changed_command(response: Response, usual: Response) -> list[Finding]:
    """A command whose sign or factor is another one from some time on."""
    parts = np.array_split(np.arange(len(response.start)), _PARTS)
    sums = response.sums(parts=parts)
    whole = _summed(sums).rest()
    best, what = _UNDONE, None
    for action in range(response.actions.shape[1]):
        power, values = response.powers[:, action], response.actions[:, action]
        if np.std(values) <= _VARIED * abs(float(np.mean(values))):
            continue  # another sign of a constant is a constant
        for factor in _FACTORS:
            undone = [one.scaled(factor ** -power.astype(np.float64)) for one in sums]
            most = 1.0 if factor < 0.0 else _OTHER_FACTOR
            for part in range(2, _PARTS - 1):
                share = _summed([*sums[:part], *undone[part:]]).rest() / whole
                if share.max() < _WORSE and share.min() < most * best:
                    best, what = float(share.min()), (action, factor, part, int(share.argmin()))
    if what is None:
        return []
    action, factor, part, state = what
    name, answer = response.system.action_names[action], response.system.state_names[state]
    begin = _finer_begin(response, action, factor, parts[part][0])
    corrected = usual.actions.copy()
    corrected[usual.t >= begin, action] /= factor
    if (usual.sums(actions=corrected)[0].rest() / usual.sums()[0].rest()).min() > _UNDONE_USUAL:
        return []
    means = "has the opposite sign" if factor < 0.0 else "acts otherwise"
    text = (
        f"{name} {means} from t = {begin:.3f} s on: it fits the answer of {answer} when it is multiplied by "
        f"{1.0 / factor:g} there ({best:.0%} of the unexplained changes remain)"
    )
    return [Finding("changed_command", f"{text}; {_done('changed_command')}", len(response.t), begin)]


def _summed(sums: Sequence[Sums]) -> Sums:
    total = sums[0]
    for one in sums[1:]:
        total = total + one
    return total


def _finer_begin(response: Response, action: int, factor: float, first: int) -> float:
    """The time from which a factor holds, to a fraction of a part."""
    width = max(1, len(response.start) // _PARTS)
    candidates = np.unique(
        np.clip(np.linspace(first - width, first + width, 13), 1, len(response.start) - 1).astype(int)
    )
    scores = []
    for window in candidates.tolist():
        row = int(response.start[window])
        actions = response.actions.copy()
        actions[row:, action] /= factor
        scores.append(float(np.log(response.sums(actions=actions)[0].rest()).sum()))
    return float(response.t[response.start[candidates[int(np.argmin(scores))]]])


@dataclass(frozen=True)
class _Group:
    """Channels whose clock may drift: indices of states, or of actions."""

    names: tuple[str, ...]
    states: tuple[int, ...] = ()
    actions: tuple[int, ...] = ()


def _groups(system: System) -> Iterator[_Group]:
    actions, states = system.action_names, system.state_names
    yield _Group(actions, actions=tuple(range(len(actions))))
    positions = tuple(at for at, item in enumerate(system.state) if not item.unit.endswith("/s"))
    if 0 < len(positions) < len(states):
        yield _Group(tuple(states[at] for at in positions), positions)
    if len(states) > 1:
        yield from (_Group((name,), (at,)) for at, name in enumerate(states) if (at,) != positions)
    if len(actions) > 1:
        yield from (_Group((name,), (), (at,)) for at, name in enumerate(actions))


def _drift(response: Response, usual: Response) -> list[Finding]:
    """Channels that come later and later, or earlier and earlier, compared with the others."""
    best, what = -0.25 * _DRIFTED, None
    for group in _groups(response.system):
        rest = _undrifted(response, group)
        for rows in (sign * size for size in _DRIFTS for sign in (1.0, -1.0)):
            gain = float(np.log(_drifted(response, group, rows).rest() / rest).sum())
            if gain < best:
                best, what = gain, (group, rows)
    if what is None:
        return []
    group, rows = what
    rest, sizes = _undrifted(response, group), [rows * by for by in (1.0, *_FINER)]
    gains = {size: np.log(_drifted(response, group, size).rest() / rest) for size in sizes}
    totals = {size: float(gain.sum()) for size, gain in gains.items()}
    rows = min(totals, key=totals.__getitem__)
    if totals[rows] > -_DRIFTED or float(np.exp(gains[rows]).min()) > _DRIFTED_STATE:
        return []
    # Between rows, interpolation smooths the noise of states, and some sizes do so more than others by chance.
    if group.states and _standard_errors(response, group, rows) < _SURE_DRIFT:
        return []
    confirmed = np.log(_drifted(usual, group, rows).rest() / _undrifted(usual, group))
    if float(confirmed.sum()) > -_CONFIRMED * _DRIFTED:
        return []
    # A clock drifts all the time; a chance coincidence is in one half. States are interpolated, which smooths their
    # noise by an offset as by a drift, so halves of them show nothing.
    if group.actions and max(_gains_of_halves(response, group, rows)) > -_EACH_HALF * _DRIFTED:
        return []
    seconds = abs(rows) * float(np.median(np.diff(response.t)))
    names, many = " and ".join(group.names), len(group.names) > 1
    answer = response.system.state_names[int(gains[rows].argmin())]
    others = "" if answer in group.names else f" the motion of {answer} and"
    text = (
        f"the clock of {names} drifts: at the end {'they come' if many else 'it comes'} {seconds:.3g} s "
        f"{'later' if rows > 0.0 else 'earlier'} than at the beginning, compared with{others} the rest of the log "
        f"({float(np.exp(gains[rows]).min()):.0%} of the unexplained changes of {answer} remain without the drift)"
    )
    return [finding("clock_drift", text, len(response.t), float(response.t[0]), _done("clock_drift", "'s times"))]


def _undrifted(response: Response, group: _Group) -> FloatArray:
    """What is unexplained without a drift; of states also with a drift of a row, which smooths noise as any other."""
    sizes = (0.0, 1.0, -1.0) if group.states else (0.0,)
    return np.asarray(np.min([_drifted(response, group, size).rest() for size in sizes], axis=0))


def _gains_of_halves(response: Response, group: _Group, rows: float) -> list[float]:
    """The change of the log of what is unexplained in each half of the log, whose regressions differ.

    A constant time offset is allowed with and without the drift: without it one half would only show that.
    """
    halves = np.array_split(np.arange(len(response.start)), 2)

    def rests(drift: float) -> FloatArray:
        tried = [_drifted_parts(response, group, drift, halves, share * rows) for share in _OFFSETS]
        return np.asarray(np.min([[np.log(part.rest()).sum() for part in parts] for parts in tried], axis=0))

    return list((rests(rows) - rests(0.0)).tolist())


def _drifted(response: Response, group: _Group, rows: float) -> Sums:
    """The sums if a group were read so many rows later at the end than at the beginning."""
    return _drifted_parts(response, group, rows)[0]


def _drifted_parts(
    response: Response,
    group: _Group,
    rows: float,
    parts: Sequence[NDArray[np.int64]] | None = None,
    offset: float = 0.0,
) -> list[Sums]:
    """The same sums for each of several groups of windows (None: all), if all were read ``offset`` rows later."""
    return response.sums(*_moved(response, group, rows, offset), parts=parts)


def _moved(response: Response, group: _Group, rows: float, offset: float) -> tuple[FloatArray, FloatArray]:
    """States and actions with a group read so many rows later at the end than at the beginning."""
    count = len(response.t)
    moved = np.arange(count) + rows * np.linspace(-0.5, 0.5, count) + offset
    at = np.clip(np.round(moved).astype(np.intp), 0, count - 1)
    states, actions = response.states, response.actions
    if group.states:
        states = states.copy()
        for index in group.states:
            states[:, index] = np.interp(moved, np.arange(count), response.states[:, index])
    if group.actions:
        actions = actions.copy()
        actions[:, group.actions] = response.actions[np.ix_(at, np.array(group.actions))]
    return states, actions


def _standard_errors(response: Response, group: _Group, rows: float) -> float:
    """The fall of the squared residuals by a drift, in its standard errors over the windows; a few count no more."""

    def squares(size: float) -> FloatArray:
        read = _moved(response, group, size, 0.0)
        matrix, changes = response.design(*read)
        scaled = matrix / (response.scale if len(response.scale) else 1.0)
        return np.asarray((changes - scaled @ response.sums(*read)[0].solution()) ** 2)

    before = min((squares(size) for size in (0.0, 1.0, -1.0)), key=lambda one: float(np.log(one.sum(axis=0)).sum()))
    most = _MEDIANS * np.median(before, axis=0) + 1e-300
    before, after = np.minimum(before, most), np.minimum(squares(rows), most)
    fall = ((before - after) / (before.mean(axis=0) + 1e-300)).sum(axis=1)
    return float(fall.sum() / (np.sqrt(len(fall)) * fall.std() + 1e-300))


_AHEAD = (2, 3, 4, 6, 8, 11, 15, 20, 28)
_BEHIND = (3, 6, 12)
"""Rows by which a change of a command is tried earlier, and later, than it is recorded."""
_EVIDENCE, _FIRST_EVIDENCE = 6.0, 1.0
"""Logarithm of the likelihood ratio from which a change counts as early; of the first one, whose time is reported."""
_APART = 6
"""Fewest rows between two changes."""
_JUMP = 0.1
"""Share of a command's range that counts as a change."""
_FEWEST, _STALE_SHARE, _TIMES_LATE = 4, 0.1, 3
"""Fewest early changes, their share, and how many times as many as late ones."""
_CLIPPED = 5.0
"""Standard deviations of a residual beyond which it counts no more."""
_MISSED = 4.0
"""Multiple of a usual step by which a command goes on after a repeat in which it was stale."""
_SLOW_SOURCE = 0.25
"""s; a command that is held for longer is a manoeuvre, not a slow source."""
_REGULAR = 0.8
"""Share of the times between changes that a source with a rate of its own explains."""
_REPEATS = 5
"""Rows of the same value after which a command that goes on with such a step may have been stale."""


def _stale(response: Response) -> list[Finding]:
    """Commands that are recorded late now and then: the robot answers to them before the log has them."""
    matrix, changes = response.design()
    matrix /= response.scale
    theta, deviation = _trimmed_fit(matrix, changes)
    count = len(response.t)
    shifts = (0, *_AHEAD, *(-shift for shift in _BEHIND))
    squares = np.empty((len(shifts), len(response.start)))
    for place, shift in enumerate(shifts):
        actions = response.actions[np.clip(np.arange(count) + shift, 0, count - 1)]
        rest = (changes - response.design(actions=actions)[0] / response.scale @ theta) / deviation
        squares[place] = np.minimum(rest**2, _CLIPPED**2).sum(axis=1)
    found, first = [], np.inf
    # A delay that is always the same is no fault: changes are compared with the shift that fits best on the whole.
    usual = squares[int(squares.sum(axis=1).argmin())]
    for action, name in enumerate(response.system.action_names):
        early, begin, share = _early_changes(response, action, squares, usual, np.array(shifts))
        if early:
            found.append((name, share))
            first = min(first, begin)
    if not found:
        return []
    names = " and ".join(name for name, _ in found)
    text = (
        f"{names} {'is' if len(found) == 1 else 'are'} stale in places: the robot answers to "
        f"{max(share for _, share in found):.0%} of the changes before the log has them"
    )
    return [finding("stale_command", text, len(found), first, _done("stale_command"))]


def _trimmed_fit(matrix: NDArray[np.float64], changes: NDArray[np.float64]) -> tuple[NDArray[np.float64], FloatArray]:
    """Least squares without the 30 % of windows that fit worst, and the deviation of the residuals by state."""
    used = np.ones(len(matrix), dtype=bool)
    for _ in range(4):
        theta = np.linalg.lstsq(matrix[used], changes[used], rcond=1e-8)[0]
        rest = changes - matrix @ theta
        deviation = 1.4826 * np.median(np.abs(rest), axis=0) + 1e-300
        worst = np.abs(rest / deviation).max(axis=1)
        used = worst <= np.quantile(worst, 0.7)
    return np.asarray(theta), np.asarray(deviation, dtype=np.float64)


def _source_rows(steps: FloatArray) -> float:
    """Rows between two values of a source that is slower than the log; 0 if changes come at any row."""
    holds = np.diff(np.flatnonzero(steps))
    holds = holds[holds > 1]
    if len(holds) < _FEWEST or len(holds) < _REGULAR * (steps > 0.0).sum():
        return 0.0
    period = float(np.quantile(holds, 0.1))
    off = np.abs(holds - period * np.round(holds / period))
    return period if float((off <= 1.0).mean()) > _REGULAR and period >= 4.0 else 0.0


def _usual_step(steps: FloatArray) -> float:
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0


def _early_changes(
    response: Response, action: int, squares: NDArray[np.float64], usual: FloatArray, shifts: NDArray[np.int64]
) -> tuple[bool, float, float]:
    """Whether a command often changes later in the log than for the robot; when first, and the share of changes."""
    values, start = response.actions[:, action], response.start
    steps = np.abs(np.diff(values))
    if 0.0 < _source_rows(steps) * float(np.median(np.diff(response.t))) <= _SLOW_SOURCE:
        return False, np.inf, 0.0  # a source that is slower than the log is late by its own rate
    same = np.convolve(steps == 0.0, np.ones(_REPEATS), "full")[: len(steps)] == _REPEATS
    large = steps > min(_JUMP * float(np.ptp(values)), _MISSED * _usual_step(steps))
    at = np.flatnonzero(np.append(False, same[:-1]) & large) + 1
    at = at[np.diff(at, prepend=-_APART) >= _APART]  # of a change over several rows the first
    shift, evidence, when = [], [], []
    for row in at.tolist():
        near = slice(*np.searchsorted(start, (row - max(_AHEAD) - 2 - response.rows, row + response.rows)).tolist())
        sums = squares[:, near].sum(axis=1)
        best = int(sums.argmin())
        if near.stop - near.start >= 3:
            shift.append(int(shifts[best]))
            known = min(float(sums[0]), float(usual[near].sum()))
            evidence.append((known - float(sums[best])) / 2.0 / response.rows)
            when.append(float(response.t[row]) - shifts[best] * float(np.median(np.diff(response.t))))
    moved, certain = np.array(shift), np.array(evidence)
    early, late = (moved > 0) & (certain > _EVIDENCE), (moved < 0) & (certain > _EVIDENCE)
    if not len(moved) or early.sum() < max(_FEWEST, _STALE_SHARE * len(moved), _TIMES_LATE * late.sum() + 1):
        return False, np.inf, 0.0
    first = int(np.flatnonzero((moved > 0) & (certain > _FIRST_EVIDENCE))[0])
    return True, when[first], float(early.mean())


_SURE, _ALONE = 8.0, 2.0
"""Standard deviations, and multiples of the next largest step, of a step that is no motion."""
_SINGLE = 0.35
"""Share of a step that its neighbouring rows may have: motion takes several rows, a new calibration one."""
_GAP = 1.75
"""Usual steps of time from which a step is a gap."""
_LEAST_STEPS = 100


def _offset(response: Response, short: Response, before: Sums) -> list[Finding]:
    """A state that steps in one row by more than its motion explains, or reads otherwise from some time on."""
    rest = before.rest()
    best: tuple[float, int, int, float] | None = None
    for state, row, size, sure in _steps(short):
        gain = float(np.log(_without_step(response, state, row, size).rest() / rest).sum())
        if (sure or gain < -_SHIFTED) and (best is None or gain < best[0]):
            best = (gain, state, row, size)
    for state, row, size in _level_candidates(response, short, before):
        gain = float(np.log(_without_step(response, state, row, size).rest() / rest).sum())
        if gain < min(-_SHIFTED, 0.0 if best is None else best[0]):
            best = (gain, state, row, size)
    if best is None:
        return []
    gain, state, row, size = best
    item = response.system.state[state]
    text = f"{item.name} reads {abs(size):.3g} {item.unit} {'more' if size > 0 else 'less'} from one row to the next"
    if gain > -_SHIFTED:
        return [finding("jump", f"{text} than its motion explains", 1, float(response.t[row]), "cut there")]
    text += " and from then on, than its motion explains: its sensor looks recalibrated"
    return [finding("offset", text, 1, float(response.t[row]), _done("offset"))]


def _steps(response: Response) -> Iterator[tuple[int, int, float, bool]]:
    """(state, row, size, whether it is certain) of the step of each state that the regression explains least."""
    m, t, start = response.rows, response.t, response.start
    rest = _residuals(response)
    # windows that follow each other row by row, so that m of them straddle a step
    follow = np.flatnonzero(start[m - 1 :] - start[: len(start) - m + 1] == m - 1)
    if len(follow) < _LEAST_STEPS:
        return
    for state in range(rest.shape[1]):
        straddling = np.lib.stride_tricks.sliding_window_view(rest[:, state], m)[follow]
        mean = straddling.mean(axis=1)
        agreed = np.where((straddling > 0.0).all(axis=1) | (straddling < 0.0).all(axis=1), mean, 0.0)
        best = int(np.abs(agreed).argmax())
        size, row = float(agreed[best]), int(start[follow[best]]) + m
        near = np.abs(start[follow] + m - row) < 3 * m
        elsewhere = float(np.abs(agreed[~near]).max(initial=0.0))
        steps = np.abs(np.diff(response.states[row - 3 : row + 3, state]))
        row += int(steps.argmax()) - 2
        sure = abs(size) > max(_SURE * 1.4826 * float(np.median(np.abs(mean))), _ALONE * elsewhere)
        if t[row] - t[row - 1] < _GAP * np.median(np.diff(t)) and _is_single(response.states[:, state], row, size):
            yield state, row, size, sure


def _is_single(values: FloatArray, row: int, size: float) -> bool:
    """Whether a step occurs from one row to the next, and not over several."""
    steps = np.diff(values[max(0, row - 4) : row + 4])
    middle = min(3, row - 1)
    usual = np.delete(steps, middle)
    own = float(steps[middle] - np.median(usual))
    return abs(own - size) < 0.5 * abs(size) and float(np.abs(usual - np.median(usual)).max()) < _SINGLE * abs(size)


def _without_step(response: Response, state: int, row: int, size: float) -> Sums:
    states = response.states.copy()
    states[row:, state] -= size
    return response.sums(states)[0]


def _level_candidates(response: Response, short: Response, before: Sums) -> Iterator[tuple[int, int, float]]:
    """(state, row, size) of offsets of rates: where the sum of some residuals turns, with the size that fits best."""
    matrix, changes = response.design()
    rest = changes - matrix / response.scale @ before.solution()
    count, reference = len(rest), before.rest()
    own = _residuals(short)
    turns = np.abs(np.cumsum(rest - rest.mean(axis=0), axis=0)) / (rest.std(axis=0) * np.sqrt(count) + 1e-300)
    inner = slice(count // 10, count - count // 10)
    for equation in range(rest.shape[1]):
        place = int(turns[inner, equation].argmax()) + inner.start
        if turns[place, equation] < _TURNED:
            continue
        row = int(response.start[place])
        for state in range(rest.shape[1]):
            step = _TRIED * float(np.ptp(response.states[:, state]))
            low, high = (
                float((_without_step(response, state, row, sign * step).rest() / reference).sum())
                for sign in (-1.0, 1.0)
            )
            curve = low + high - 2.0 * rest.shape[1]  # the sum of squares is a parabola of the step
            size = step * float(np.clip(0.5 * (low - high) / curve, -_FARTHEST, _FARTHEST)) if curve > 0.0 else 0.0
            size = size or (step if high < low else -step)
            if min(low, high) < rest.shape[1]:
                at, by = _refined(response, state, row, size)
                if _steps_there(short, own, state, at, by):
                    yield state, at, by


def _residuals(response: Response) -> NDArray[np.float64]:
    matrix, changes = response.design()
    return np.asarray(changes - matrix / response.scale @ response.sums()[0].solution())


def _steps_there(response: Response, rest: NDArray[np.float64], state: int, row: int, size: float) -> bool:
    """Whether the changes of a state across a row hold a step of that size, which an offset of it must have."""
    best = 0.0
    for at in range(row - _NEAR, row + _NEAR + 1):
        across = rest[(response.start < at) & (response.start + response.rows >= at), state]
        best = max(best, float(np.sign(size) * across.mean()) if len(across) else 0.0)
    return best > _PART_OF_STEP * abs(size)


_NEAR, _PART_OF_STEP = 4, 0.5
"""Rows around an offset in which its step is looked for, and the share of it that must be there."""


def _refined(response: Response, state: int, row: int, size: float) -> tuple[int, float]:
    """The offset near a row and a size with the smallest residual."""

    def score(at: int, by: float) -> float:
        return float(np.log(_without_step(response, state, at, by).rest()).sum())

    reach = max(8, len(response.t) // 50)
    for _ in range(2):
        for width in (reach, reach // 4, reach // 16):
            near = {min(max(row + width * place // 4, 1), len(response.t) - 1) for place in range(-4, 5)}
            row = min(near, key=lambda at: score(at, size))
        size *= min((0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0), key=lambda factor: score(row, factor * size))
    return row, size


_TRIED, _FARTHEST = 0.05, 6.0
"""Share of a state's range that is tried as an offset, and how many times as far the best one may be."""
_TURNED = 1.5
"""Largest partial sum of centred residuals in units of sqrt(n); 1.36 is exceeded by chance in 5 % (Kolmogorov)."""
