"""Whether a measured state can be believed: compared with the prediction from the one before.

With x the measured state, x^ the model's prediction from the last believed state along the action that was applied, and
e = x - x^ (angles wrapped), four things are checked for the entries of each unit together:

    jump:        |e| over one period; after lost states it may be up to eight times as large
    drift:       |sum of e| over the last two seconds, positions only: a pose that contradicts its own rates; while the
                 robot rests, over the last six
    slow drift:  the same between the means of the first and the last half second of four, without lost states; the
                 noise of single states cancels in the means, so its limit is lower
    unanswered:  the motion and the rate that the commands should have caused since the position last changed, within a
                 second; a state that differs from the one before may leave three times as much unanswered
    repeats:     the state is exactly the one before, although its own rates say that the position changes
    clock:       the stamps advance at another rate than the states arrive

The thresholds are ``StateLimits``. For the first two the level of noise that the state usually has counts as well.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from math import hypot, inf, pi
from types import MappingProxyType
from typing import Final, NamedTuple, final

from safedpa.safety.session.state_limits import Evidence, StateLimits
from safedpa.systems import System

__all__ = ["CREEPING_FACTOR", "NO_CONTRADICTION", "ClockMonitor", "Contradiction", "StateMonitor"]

Plain = tuple[float, ...]

_DRIFT_SECONDS: Final = 2.0
_REST_SECONDS: Final = 6.0
"""Time [s] over which the position of a resting robot may not drift by the limit: noise does not add up meanwhile."""
_REST_SHARE: Final = 0.02
"""Share of the limit of a jump below which the motion of a period counts as rest."""
_LONG_DRIFT_SECONDS: Final = 4.0
_MEAN_SECONDS: Final = 0.5
_SLOW_DRIFT: Final = 0.8
"""Share of the limit of ``drift`` for the means: noise hardly counts in them, but each change of the acceleration under
an unknown delay moves the prediction, by up to half of that limit."""
_SLOW_DRIFT_SHARE: Final = 0.6
"""The same for the share of the way: over twice the time its largest values are closer to the usual ones."""
_ANSWER_SECONDS: Final = 1.0
_ANSWERED: Final = 0.1
"""Share of the predicted motion from which the robot counts as moving."""
_EXACT_SHARE: Final = 2.0 / 3.0
"""Share of the limit of ``unanswered`` for rates of a state that is exactly the one before: it needs no reserve for
noise. A robot that commands within its dead zone do not move is exactly at rest, too, but its rates are low. It counts
of a source whose states of a resting robot differ: one that repeats them may show a robot that answers late."""
_VARIES: Final = 0.03
"""Share of the limit of a jump by which the states of a robot at rest differ because of noise."""
_RATED_FACTOR: Final = 2.0
"""Factor on the limit of ``unanswered`` for a position whose rate is judged, too: what moves it slowly is left, such as
commands within a dead zone that the model does not have."""
CREEPING_FACTOR: Final = 3.0
"""Factor on the limit of ``unanswered`` for a state that differs from the one before: its sensor is not frozen, and a
robot whose commands hardly overcome its friction creeps."""
_MOVING: Final = 10.0
"""Limits of a jump that a robot must have moved in that time: in one that hardly moves, the errors of its predicted
acceleration add up to more than the drift."""
_UNRATED_FACTOR: Final = 2.0
"""Factor on the share of the way of a drift for a position without a measured rate, such as a car's heading: only the
commands tell its rate, and they may act late. In a car that turns to and fro, these errors add up."""
_DRIFTS: Final = "its position and its rates differ by {:.2g} {} within {:.2g} s"
_WHY_NOT: Final = " (a frozen sensor, a robot that is held, or an unknown delay)"
_LOST_GROWTH: Final = 1.0
_MOST_GROWTH: Final = 8.0
"""Each lost period adds this share to the limit of a jump, up to this factor: the prediction becomes less certain."""
_NOISE_FACTOR: Final = 6.5
"""Medians of |e| that count as noise: one state in 10 million of a normal distribution in the plane is beyond it."""
_MOST_NOISE: Final = 5.0
"""Factor by which noise may raise a limit: a state that keeps jumping must not become usual."""
_GAPS_FACTOR: Final = 2.0
"""Factor on the limit of a drift after lost states: the noise of consecutive errors then no longer cancels in their
sum."""
_NOISE_STEP: Final = 0.02
"""Share by which the estimated median changes per state."""


class _Sums(NamedTuple):
    """Running sums at one state since the last lost one."""

    errors: Plain
    """(states,) sum of the errors."""
    of_errors: Plain
    """(states,) sum of these sums, for their means."""
    ways: dict[str, float]
    """Predicted motion by unit."""


class Contradiction(NamedTuple):
    """Why a state cannot be believed."""

    text: str
    """With the numbers; empty if it can be believed."""
    trusted: tuple[int, ...]
    """Entries of the state that do not take part in it: braking may use them."""


NO_CONTRADICTION: Final = Contradiction("", ())


@final
class _RunningSums:
    """Sums over the last rows; a new row costs the same however many there are."""

    def __init__(self, longest: int) -> None:
        self._rows: deque[Plain] = deque(maxlen=longest)
        self.totals: Plain = ()

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: Plain) -> None:
        """Adds the newest row, and takes the oldest away once there are as many as can be."""
        if not self._rows:
            self.totals = row
        elif len(self._rows) == self._rows.maxlen:
            self.totals = tuple([a + b - c for a, b, c in zip(self.totals, row, self._rows[0], strict=True)])
        else:
            self.totals = tuple([a + b for a, b in zip(self.totals, row, strict=True)])
        self._rows.append(row)

    def clear(self) -> None:
        """Forgets all rows, and with them the rounding of the sums."""
        self._rows.clear()
        self.totals = ()


@final
class StateMonitor:
    """Judges the states of one robot. Call ``observe`` with each one, and ``accept`` with those that are believed."""

    def __init__(self, system: System, limits: StateLimits, period: float) -> None:
        self._system, self._limits, self._period = system, limits, period
        self._angles = frozenset(system.angles)
        units = dict.fromkeys(each.unit for each in system.state)
        self._groups = {
            unit: tuple(index for index, each in enumerate(system.state) if each.unit == unit) for unit in units
        }
        self._positions = [unit for unit in units if "/s" not in unit]
        self._rates = {f"{unit}/s": unit for unit in self._positions if f"{unit}/s" in units}
        """Units of the rates of positions, with those of the positions."""
        self._varies_at_rest = False
        """Whether the source has shown a robot that rests by states that differ: then equal ones are suspicious."""
        self._noise = {unit: limits.jump.get(unit, 0.0) / _NOISE_FACTOR for unit in units}
        """Running median of |e| by unit."""
        self.restart()

    def restart(self) -> None:
        """Forgets the motion so far; the noise is still known."""
        self._window = max(2, round(_DRIFT_SECONDS / self._period))
        self._mean_states = max(1, round(_MEAN_SECONDS / self._period))
        longer = max(2 * self._mean_states, round(_LONG_DRIFT_SECONDS / self._period))
        self._sums: deque[_Sums] = deque(maxlen=longer)
        self._recent = _RunningSums(self._window)
        """Of the last states: the errors, then the predicted motion of each position."""
        self._gaps: deque[bool] = deque(maxlen=self._window)
        """Whether a state was lost before each of the last ones."""
        self._resting = _RunningSums(max(2, round(_REST_SECONDS / self._period)))
        """The same of the last states while the robot rested."""
        self._drift_at_rest: dict[str, tuple[float, float]] = {}
        self._slow_drift: dict[str, tuple[float, float]] = {}
        self._unchanged = False
        """Whether no entry of the newest state differs from the one before."""
        self._anchor: Plain = ()
        self._free: Plain = ()
        self._anchored = 0

    @property
    def free(self) -> Plain:
        """(states,) prediction since the position last changed, to be advanced by each action; empty: none."""
        return self._free

    @property
    def anchor(self) -> tuple[Plain, int]:
        """The state (states,) at which the position last changed, and the periods since, the newest included."""
        return self._anchor, self._anchored + 1

    def observe(self, values: Plain, before: Plain, predicted: Plain, free: Plain = ()) -> Evidence:
        """What the state (states,) shows after ``before``, the last believed one, from which it was ``predicted``.

        ``free`` is the property of that name, one period later.
        """
        self._unchanged = values == before
        error = self._difference(values, predicted)
        way = self._difference(predicted, before)
        jump = {unit: _norm(error, own) for unit, own in self._groups.items()}
        ways = {unit: _norm(way, self._groups[unit]) for unit in self._positions}
        self._newest = error, ways
        self._slow_drift = self._drift_of_means(error)
        # A shorter rest is within the window of a drift.
        rested = len(self._resting) >= self._window
        self._drift_at_rest = self._drift(self._resting, error, dict.fromkeys(ways, 0.0)) if rested else {}
        self._free = free
        drift = self._drift(self._recent, error, ways)
        return Evidence(jump, drift, self._unanswered(values), self._overbraking(values, before, predicted))

    def _drift(self, past: _RunningSums, error: Plain, ways: dict[str, float]) -> dict[str, tuple[float, float]]:
        """|sum of the errors|, the newest included, and the way in that time, by unit of a position."""
        totals = past.totals or (0.0,) * (len(error) + len(ways))
        return {
            unit: (hypot(*[error[index] + totals[index] for index in self._groups[unit]]), way + totals[place])
            for place, (unit, way) in enumerate(ways.items(), start=len(error))
        }

    def rates(self, values: Plain) -> dict[str, float]:
        """The size of each rate of the positions, by unit."""
        return {unit: _norm(values, self._groups[unit]) for unit in self._rates}

    def distances(self, one: Plain, other: Plain) -> dict[str, float]:
        """The size of the difference of two states (states,), by unit."""
        error = self._difference(one, other)
        return {unit: _norm(error, own) for unit, own in self._groups.items()}

    def nearest_between(self, one: Plain, other: Plain, values: Plain) -> Plain:
        """The state (states,) between two predictions that is nearest to a measured one, by the limits of a jump."""
        way, error = self._difference(other, one), self._difference(values, one)
        weights = [1.0 / max(self._limits.jump.get(each.unit, inf), 1e-9) ** 2 for each in self._system.state]
        length = sum(weight * a * a for weight, a in zip(weights, way, strict=True))
        along = sum(weight * a * b for weight, a, b in zip(weights, way, error, strict=True))
        share = min(max(along / length, 0.0), 1.0) if length else 0.0
        return tuple([a + share * b for a, b in zip(one, way, strict=True)])

    def falling(self, before: Plain, predicted: Plain) -> list[str]:
        """Units of the rates that are predicted to become smaller."""
        now = self.rates(before)
        return [unit for unit, size in self.rates(predicted).items() if size < now[unit]]

    def claimed_motion(self, values: Plain, seconds: float) -> dict[str, float]:
        """By how much of its ``jump`` limit each position must have changed in ``seconds`` [s] by its own rates."""
        found = {}
        for rate, unit in self._rates.items():
            limit = self._limits.jump.get(unit, 0.0)
            found[unit] = seconds * _norm(values, self._groups[rate]) / limit if limit else 0.0
        return found

    def accept(self, values: Plain, evidence: Evidence | None, lost: int = 0) -> bool:
        """Takes in a believed state and what ``observe`` returned for it; None for the first one.

        ``lost``: states lost before it; the error of a longer prediction is no drift. Returns whether ``free`` begins
        at this state again.
        """
        if evidence is not None:
            error, ways = self._newest
            row = (*error, *ways.values())
            self._recent.add((*((0.0,) * len(error)), *ways.values()) if lost else row)
            self._gaps.append(lost > 0)
            self._add(error, ways, lost)
            if lost or any(way > _REST_SHARE * self._limits.jump.get(unit, 0.0) for unit, way in ways.items()):
                self._resting.clear()
            else:
                self._resting.add(row)
                # A creeping robot varies as well, but by less, and not for so long.
                varies = any(size > _VARIES * self._limits.jump.get(unit, inf) for unit, size in evidence.jump.items())
                self._varies_at_rest |= varies and len(self._resting) >= self._window
            for unit, size in evidence.jump.items():
                step = _NOISE_STEP * self._noise[unit]
                self._noise[unit] += step if size > self._noise[unit] else -step
        since = self._since_anchor(values)
        moved = any(
            moved > _ANSWERED * commanded for unit, (commanded, moved) in since.items() if unit not in self._rates
        )
        self._anchored += 1
        again = moved or not self._anchor or not self._free or self._anchored * self._period > _ANSWER_SECONDS
        if again:
            self._anchor = self._free = values
            self._anchored = 0
        return again

    def _add(self, error: Plain, ways: dict[str, float], lost: int) -> None:
        """Adds to the running sums, which begin again after a lost state."""
        if lost:
            self._sums.clear()
            return
        if not self._sums:
            zeros = (0.0,) * len(error)
            self._sums.append(_Sums(zeros, zeros, dict.fromkeys(ways, 0.0)))
        last = self._sums[-1]
        errors = tuple([a + b for a, b in zip(last.errors, error, strict=True)])
        of_errors = tuple([a + b for a, b in zip(last.of_errors, errors, strict=True)])
        self._sums.append(_Sums(errors, of_errors, {unit: last.ways[unit] + way for unit, way in ways.items()}))

    def _drift_of_means(self, error: Plain) -> dict[str, tuple[float, float]]:
        """|difference of the means of the summed errors|, and the way in that time, for positions with rates."""
        sums, count = self._sums, self._mean_states
        if sums.maxlen is None or len(sums) < sums.maxlen:
            return {}
        first, second, before, last = sums[0], sums[count], sums[-count], sums[-1]
        found = {}
        for unit in self._rates.values():
            way = last.ways[unit] - first.ways[unit]
            if way < _MOVING * self._limits.jump.get(unit, 0.0):
                continue
            parts = []
            for index in self._groups[unit]:
                newest = last.errors[index] + error[index] + last.of_errors[index] - before.of_errors[index]
                parts.append((newest - second.of_errors[index] + first.of_errors[index]) / count)
            found[unit] = hypot(*parts), way
        return found

    def problem(
        self, evidence: Evidence, lost: int = 0, unknown: Mapping[str, float] = MappingProxyType({})
    ) -> Contradiction:
        """Why the state cannot be believed, with the numbers; empty if it can.

        ``lost``: states lost before it. ``unknown``: by how much more it may differ from its prediction, by unit.
        """
        growth = min(1.0 + _LOST_GROWTH * lost, _MOST_GROWTH)
        for unit, size in evidence.jump.items():
            limit = self._with_noise(self._limits.jump.get(unit), unit)
            largest = None if limit is None else growth * limit + unknown.get(unit, 0.0)
            if largest is not None and not size <= largest:
                text = f"it jumped by {size:.2g} {unit} against the prediction (at most {largest:.2g} {unit})"
                return self._contradiction(size, unit, text)
        for unit, (size, way) in () if lost else evidence.drift.items():
            limit = self._with_noise(self._limits.drift.get(unit), unit)
            if limit is not None:
                limit *= _GAPS_FACTOR if any(self._gaps) else 1.0
                factor = 1.0 if f"{unit}/s" in self._rates else _UNRATED_FACTOR
                limit += factor * self._limits.drift_share.get(unit, 0.0) * way
                if not size <= growth * limit:
                    text = f"{_DRIFTS.format(size, unit, _DRIFT_SECONDS)} (at most {growth * limit:.2g} {unit})"
                    return self._contradiction(size, unit, text)
        if not lost and (slow := self._problem_of_slow_drift()).text:
            return slow
        for unit, size in evidence.unanswered.items():
            limit = self._limits.unanswered.get(unit)
            factor = _RATED_FACTOR if f"{unit}/s" in self._rates else 1.0
            if not self._unchanged:
                factor *= CREEPING_FACTOR
            elif unit in self._rates and self._varies_at_rest:
                factor = _EXACT_SHARE
            if limit is not None and size > factor * limit:
                text = f"it does not change although the commands should have moved it by {size:.2g} {unit}{_WHY_NOT}"
                return Contradiction(text, ())
        return NO_CONTRADICTION

    def _contradiction(self, size: float, unit: str, text: str) -> Contradiction:
        """``text``, unless the state is exactly the one before."""
        if self._unchanged:
            return Contradiction(f"it does not change although it should have moved by {size:.2g} {unit}", ())
        return Contradiction(text, self._others({unit}))

    def _problem_of_slow_drift(self) -> Contradiction:
        at_rest = self._period * (1 + len(self._resting))
        over = self._period * len(self._sums)
        for drifts, share, way_share, seconds, when in (
            (self._slow_drift, _SLOW_DRIFT, _SLOW_DRIFT_SHARE, over, ""),
            (self._drift_at_rest, 1.0, 1.0, at_rest, " while it rests"),
        ):
            for unit, (size, way) in drifts.items():
                limit = self._with_noise(self._limits.drift.get(unit), unit)
                if limit is None:
                    continue
                limit = share * limit + way_share * self._limits.drift_share.get(unit, 0.0) * way
                if not size <= limit:
                    text = f"{_DRIFTS.format(size, unit, seconds)}{when} (at most {limit:.2g} {unit})"
                    return Contradiction(text, self._others({unit}))
        return NO_CONTRADICTION

    def _others(self, units: set[str]) -> tuple[int, ...]:
        return tuple(index for unit, own in self._groups.items() if unit not in units for index in own)

    def _with_noise(self, limit: float | None, unit: str) -> float | None:
        if limit is None:
            return None
        return max(limit, min(_NOISE_FACTOR * self._noise[unit], _MOST_NOISE * limit))

    def _unanswered(self, values: Plain) -> dict[str, float]:
        since = self._since_anchor(values)
        if not since:
            return dict.fromkeys((*self._positions, *self._rates), 0.0)
        return {
            unit: commanded if moved <= _ANSWERED * commanded else 0.0 for unit, (commanded, moved) in since.items()
        }

    def _since_anchor(self, values: Plain) -> dict[str, tuple[float, float]]:
        """By unit: how far the commands should have moved the robot since the position last changed, and how far it is.

        Empty if that is not known.
        """
        if not (self._anchor and self._free):
            return {}
        commanded, moved = self._difference(self._free, self._anchor), self._difference(values, self._anchor)
        return {
            unit: (_norm(commanded, self._groups[unit]), _norm(moved, self._groups[unit]))
            for unit in (*self._positions, *self._rates)
        }

    def _overbraking(self, values: Plain, before: Plain, predicted: Plain) -> dict[str, float]:
        found = {}
        for unit in self._rates:
            own = self._groups[unit]
            speed = _norm(before, own)
            expected, measured = (
                sum(row[index] * before[index] for index in own) / speed if speed else 0.0
                for row in (predicted, values)
            )
            found[unit] = max(0.0, expected - measured) if expected < speed else 0.0
        return found

    def _difference(self, one: Sequence[float], other: Sequence[float]) -> Plain:
        return tuple(
            [
                (a - b + pi) % (2.0 * pi) - pi if index in self._angles else a - b
                for index, (a, b) in enumerate(zip(one, other, strict=True))
            ]
        )


_LONGEST_INTERVAL: Final = 1.5
"""s between two states that show a rate: a longer one is a pause."""
_LEAD: Final = 0.6
"""s by which stamps may advance further than arrivals within the last seconds: a robot that was late catches up."""
_LEAD_SECONDS: Final = 2.0
_LEAD_AT_FIRST: Final = 0.19
"""s of lead from which the robot brakes until it is explained: 0.3 s of a clock at a rate of 3."""
_RATE: Final = "its stamps advance {:.2g} times as fast as the states arrive"
_SLOW: Final = 0.5
"""Ratio of stamps to arrivals that is no jitter if every interval shows it."""
_SLOW_SECONDS: Final = 3.0
"""Time [s] of arrivals for which stamps must be slow: a busy machine may be slow for a while."""
_LAG: Final = 0.21
"""s by which stamps may fall behind the arrivals within ``_LAG_SECONDS``: 0.3 s of a clock at a rate of 0.3."""
_LAG_SECONDS: Final = 1.0
_BEHIND: Final = "; they have fallen {:.2f} s behind within a second"
_AHEAD: Final = "; they lead by {:.2f} s more than in the seconds before"


@final
class ClockMonitor:
    """Compares the stamps of the states with their arrivals.

    The lead is the sum of (interval of stamps - interval of arrivals). A robot that was held up catches up to the lead
    that it had; a clock that is fast goes beyond every lead before. States that are held up and a slow clock look alike
    at first: ``lag`` is by how much the states are then older than their arrivals say.
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None
        self._restart(0.0)

    def _restart(self, arrived: float) -> None:
        self._lead, self._peak = 0.0, 0.0
        """Lead of now, and the largest until _LEAD_SECONDS ago."""
        self._leads: deque[tuple[float, float]] = deque()
        """Arrival and lead of the states since."""
        self._largest: deque[tuple[float, float]] = deque([(arrived, 0.0)])
        """Arrival and lead of the states of the last second that lead more than all after them."""
        self._slow: list[tuple[float, float]] = []
        """Intervals of stamps and arrivals since the clock was last not slow."""
        self._is_known = False
        """Whether the largest lead of earlier seconds is known."""

    @property
    def lag(self) -> float:
        """Time [s] by which the newest stamp is behind its arrival, compared with the best of the last second."""
        return self._largest[0][1] - self._lead

    @property
    def ahead(self) -> str:
        """Why the newest stamp leads by more than ever before; empty if it does not. It passes, or the clock is fast.

        States that were held up in all of the last seconds, and then are not, look the same.
        """
        more = self._lead - self._peak
        if not self._is_known or more <= _LEAD_AT_FIRST:
            return ""
        return self._ratio() + _AHEAD.format(more)

    @property
    def behind(self) -> str:
        """Why the newest state is too old by its stamp; empty if it is not. It passes: nothing else is known yet."""
        if self.lag <= _LAG:
            return ""
        seconds = self._largest[-1][0] - self._largest[0][0]
        return _RATE.format(max(0.0, 1.0 - self.lag / seconds)) + _BEHIND.format(self.lag)

    def _ratio(self) -> str:
        """The rate of the stamps since the lead was last no larger than ever before."""
        now, lead = self._leads[-1]
        since, before = next((one for one in reversed(self._leads) if one[1] <= self._peak), self._leads[0])
        return _RATE.format(1.0 + (lead - before) / (now - since) if now > since else inf)

    def observe(self, stamp: float, arrived: float) -> str:
        """Why the stamps [s] cannot be believed at this arrival [s] by another clock; empty if they can."""
        last, self._last = self._last, (stamp, arrived)
        if last is None:
            self._restart(arrived)
            return ""
        stamps, arrivals = stamp - last[0], arrived - last[1]
        # A clock that was set, or that has not advanced, shows no rate.
        if not (0.0 < stamps < _LONGEST_INTERVAL and 0.0 < arrivals < inf):
            self._restart(arrived)
            return ""
        self._lead += stamps - arrivals
        while self._largest and self._largest[-1][1] <= self._lead:
            self._largest.pop()
        self._largest.append((arrived, self._lead))
        # The newest one before that second stays: the newest state may have been held up for longer than that.
        while len(self._largest) > 1 and self._largest[1][0] < arrived - _LAG_SECONDS:
            self._largest.popleft()
        self._leads.append((arrived, self._lead))
        while self._leads[0][0] <= arrived - _LEAD_SECONDS:
            self._is_known, self._peak = True, max(self._peak, self._leads.popleft()[1])
        if self._lead - self._peak > _LEAD:
            return self._ratio()
        if stamps < _SLOW * arrivals < _SLOW * _LONGEST_INTERVAL:
            self._slow.append((stamps, arrivals))
        else:
            self._slow.clear()
        seconds = sum(interval for _, interval in self._slow)
        if seconds >= _SLOW_SECONDS:
            return _RATE.format(sum(interval for interval, _ in self._slow) / seconds)
        return ""


def _norm(values: Sequence[float], indices: Sequence[int]) -> float:
    return hypot(*[values[index] for index in indices])
