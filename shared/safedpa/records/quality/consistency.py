"""Checks whether the columns agree with each other in size, sign and time.

Compared are speed and change of position, heading and direction of motion, a driven state and its command, and the
delay of a measured rate against the derivative of its quantity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.records.column_map.derive import slopes_within
from safedpa.records.quality.clock import hold_rows
from safedpa.records.quality.findings import finding
from safedpa.records.run import Finding, RawRows, Stretch
from safedpa.systems import System

__all__ = ["consistency_findings", "drive_findings", "late_findings"]

_MAX_SHIFT = 1.0
"""Largest shift that is tried in either direction, s."""
_MIN_CORRELATION = 0.9
"""Correlation at the best shift below which a rate and a slope are not compared."""
_MIN_IMPROVEMENT = 0.02
"""Smallest improvement of the correlation by a shift."""
_SEVERE_OFFSET = 0.15
"""s; from it, and from twice the hold of a channel, a shift must be corrected before the log is used."""
_MIN_OFFSET = 0.05
"""s; smaller shifts are not reported."""


def late_findings(rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """Reports measured rates that are delayed against the derivative of their quantity; nothing is cut."""
    found = []
    for name, rate, slope in _rates_and_slopes(rows, stretches, system, measured):
        late = _delay(rows.t, rate, slope)
        if late is None or abs(late[0]) < _MIN_OFFSET:
            continue
        seconds, best, now = late
        held = hold_rows(rate[np.isfinite(rate)]) * _median_step(rows.t)
        side = "late" if seconds > 0 else "early"
        kind = "time_offset" if abs(seconds) >= max(_SEVERE_OFFSET, 2.0 * held) else "slightly_late"
        text = (
            f"{name} comes {abs(seconds):.2f} s {side} against the change of what it is the rate of (correlation "
            f"{best:.3f} when it is shifted, {now:.3f} as it is)"
        )
        done = f"align it with shift = {seconds:.2f} for {name} in a column map"
        found.append(finding(kind, text, done=done))
    return found


def _rates_and_slopes(
    rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]
) -> list[tuple[str, FloatArray, FloatArray]]:
    """(name of a measured rate, its values, the derivative that it should equal)."""
    names, states = system.state_names, rows.states
    if {"x", "y", "yaw", "speed"} <= set(names):
        index = names.index("speed")
        x, y, yaw = (states[:, names.index(name)] for name in ("x", "y", "yaw"))
        along = slopes_within(rows.t, x, stretches, _WINDOW) * np.cos(yaw) + slopes_within(
            rows.t, y, stretches, _WINDOW
        ) * np.sin(yaw)
        return [("speed", states[:, index], along)] if measured[index] else []
    found = []
    for at, variable in enumerate(system.state):
        for index, rate in enumerate(system.state):
            if rate.unit == f"{variable.unit}/s" and measured[index] and measured[at]:
                found.append((rate.name, states[:, index], slopes_within(rows.t, states[:, at], stretches, _WINDOW)))
    return found


def _delay(t: FloatArray, rate: FloatArray, slope: FloatArray) -> tuple[float, float, float] | None:
    """(delay [s] of ``rate`` after ``slope``, correlation when shifted, correlation without); None if unclear."""
    period = _median_step(t)
    if not period > 0.0:
        return None
    most = max(1, round(_MAX_SHIFT / period))
    step = max(1, most // 40)
    shifts = np.unique(np.concatenate([np.arange(-most, most + 1, step), [0]]))
    values = np.array([_correlation_when_shifted(rate, slope, int(shift)) for shift in shifts])
    best = int(np.nanargmax(values)) if np.isfinite(values).any() else -1
    if best < 0 or values[best] < _MIN_CORRELATION:
        return None
    around = np.arange(shifts[best] - step, shifts[best] + step + 1)
    finer = np.array([_correlation_when_shifted(rate, slope, int(shift)) for shift in around])
    top = int(np.nanargmax(finer))
    now = _correlation_when_shifted(rate, slope, 0)
    if finer[top] < now + _MIN_IMPROVEMENT or abs(around[top]) >= most:
        return None
    return float(around[top]) * period, float(finer[top]), now


def _median_step(t: FloatArray) -> float:
    """Median time between rows [s]; 0 without rows."""
    steps = np.diff(t[np.isfinite(t)])
    return float(np.median(steps)) if len(steps) else 0.0


def _correlation_when_shifted(rate: FloatArray, slope: FloatArray, shift: int) -> float:
    """Correlation of rate[k + shift] with slope[k]."""
    if abs(shift) > len(rate) - _MIN_PAIRS:
        return float("nan")
    if shift >= 0:
        one, other = rate[shift:], slope[: len(slope) - shift]
    else:
        one, other = rate[:shift], slope[-shift:]
    good = np.isfinite(one) & np.isfinite(other)
    if good.sum() < _MIN_PAIRS or not (np.ptp(one[good]) > 0 and np.ptp(other[good]) > 0):
        return float("nan")
    return float(np.corrcoef(one[good], other[good])[0, 1])


_DRIVES = {"throttle": "speed", "target_speed": "speed", "torque": "rate"}
"""State that grows with each action."""
_MIN_PAIRS, _MAX_PAIRS = 100, 20_000
"""Rows that a correlation needs, and from twice of which on it is taken over evenly spread ones."""
_OPPOSITE = 0.5
"""Negative partial correlation from which a state certainly opposes its command."""
_FOLLOWS = 0.05
"""Share of a command's variation that a state which follows it closely leaves unexplained."""
_SIGNIFICANT = 0.3
"""Partial correlation from which a delay counts."""


def drive_findings(rows: RawRows, stretches: list[Stretch], system: System) -> list[Finding]:
    """Reports actions that slow down the state that they should drive; nothing is cut.

    The action is correlated with the residual of d(state)/dt after regression on the state and a constant, at delays of
    up to half a second. Drag, gain, lag and load change the size of this correlation but not its sign.
    """
    found = []
    for index, variable in enumerate(system.action):
        driven = _DRIVES.get(variable.name)
        if driven not in system.state_names:
            continue
        value = _correlate(rows, stretches, rows.actions[:, index], system, driven)
        if value < -_OPPOSITE:
            text = f"{driven} falls as {variable.name} rises (correlation {value:.2f} next to what else drives it)"
            done = f"flip {variable.name} in a column map"
            found.append(finding("opposite_sign", text, done=done))
    return found


def _correlate(rows: RawRows, stretches: list[Stretch], action: FloatArray, system: System, driven: str) -> float:
    """Partial correlation of the derivative of a state with an earlier action."""
    at = system.state_names.index(driven)
    slopes = slopes_within(rows.t, rows.states[:, at], stretches, _WINDOW)
    angles = [np.sin(rows.states[:, index]) for index, item in enumerate(system.state) if item.angle]
    covariates = np.column_stack([rows.states[:, at], np.ones(len(rows.t)), *angles])
    steps = np.diff(rows.t[np.isfinite(rows.t)])
    period = float(np.median(steps)) if len(steps) else 1.0
    most = max(0, round(_MAX_DELAY / max(period, 1e-6)))
    shifts = range(0, most + 1, max(1, most // 10))
    values = [_partial_correlation(slopes, action, covariates, shift) for shift in shifts]
    # a delay of half an oscillation inverts the sign, so the first significant delay decides
    first = next((value for value in values if abs(value) > _SIGNIFICANT), 0.0)
    return min(values) if first < 0.0 else max(first, 0.0)


def _partial_correlation(slopes: FloatArray, action: FloatArray, covariates: NDArray[np.float64], shift: int) -> float:
    """Partial correlation of slopes[k + shift] with action[k], given the covariates (rows, columns) at k + shift."""
    count = len(slopes) - shift
    if count < _MIN_PAIRS:
        return 0.0
    every = max(1, count // _MAX_PAIRS)
    wanted, command, columns = slopes[shift::every], action[:count:every], covariates[shift::every]
    good = np.isfinite(wanted) & np.isfinite(command) & np.isfinite(columns).all(axis=1)
    if good.sum() < _MIN_PAIRS or not np.ptp(command[good]) > 1e-9:
        return 0.0
    both = np.column_stack([wanted[good], command[good]])
    residual = both - columns[good] @ np.linalg.lstsq(columns[good], both, rcond=None)[0]
    if float(residual[:, 1].std()) < _FOLLOWS * float(command[good].std()):
        # The state follows its command so closely that nothing is left to correlate; its direction says the same.
        return _correlation(columns[:, 0], command)
    size = float(np.sqrt((residual[:, 0] ** 2).sum() * (residual[:, 1] ** 2).sum()))
    return float(residual[:, 0] @ residual[:, 1]) / size if size > 1e-12 else 0.0


_WINDOW = 0.2
"""Window of the derivatives, s: long enough to average noise, short compared with the motion."""
_MIN_ROWS = 30
_SCALE_TOLERANCE = 0.2
_MIN_STEERED_ROWS = 100
"""Fewest rows for a check of the steering."""
_MIN_STEERING = 0.03
"""Smallest standard deviation (rad or rad/s) for a check of the steering."""
_MAX_DELAY = 0.5
"""Largest delay of the heading after the steering, s."""
_DEPENDENT = 0.5
"""Correlation above which the heading certainly depends on the steering."""
_UNRELATED = 0.2
"""Correlation below which it certainly does not."""
_MISTAKES = (
    (1.0 / 3.6, "km/h"),
    (3.6, "t or speed scaled the other way (m/s divided by 3.6)"),
    (1.0 / 2.2369, "mph"),
    (0.01, "cm/s"),
    (0.001, "mm/s, or t in milliseconds"),
    (180.0 / np.pi, "radians while the angle is in degrees"),
    (np.pi / 180.0, "deg/s"),
    (2.0 * np.pi / 60.0, "rpm"),
    (1000.0, "m/s while positions are in mm"),
    (100.0, "m/s while positions are in cm"),
)
"""Ratio of the derivative of the position to the measured speed, and the probable unit of the speed."""


def consistency_findings(
    rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]
) -> list[Finding]:
    """Reports columns that contradict each other; nothing is cut."""
    names, actions = system.state_names, system.action_names
    if {"x", "y", "yaw", "speed"} <= set(names):
        found = _car(rows, stretches, names, measured[names.index("speed")])
        return found or _steering(rows, stretches, system) + _turn_rate(rows, stretches, names, measured)
    # What another action turns is no pendulum, and 0 need not be upright.
    if {"angle", "rate", "torque"} <= {*names, *actions}:
        angle, rate = (rows.states[:, names.index(name)] for name in ("angle", "rate"))
        moved = slopes_within(rows.t, angle, stretches, _WINDOW)
        found = _scale("rate", "angle", rate, moved) if measured[names.index("rate")] else []
        return found + _upright(angle, moved, slopes_within(rows.t, moved, stretches, _WINDOW), rows.actions)
    return _declared_rates(rows, stretches, system, measured)


def _declared_rates(rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """Compares every declared rate with the slope of the position that it follows: sign, unit and scale."""
    found = []
    for at, item in enumerate(system.state):
        pairs = []
        for index, rate in enumerate(system.state):
            if rate.unit == f"{item.unit}/s" and measured[at] and measured[index]:
                slopes = slopes_within(rows.t, rows.states[:, at], stretches, _WINDOW)
                pairs.append((abs(_correlation(rows.states[:, index], slopes)), index, slopes))
        if pairs:
            correlation, index, slopes = max(pairs, key=lambda pair: pair[0])
            if correlation > _SURELY_PAIRED:
                found += _scale(system.state[index].name, item.name, rows.states[:, index], slopes)
    return found


_SURELY_PAIRED = 0.95
"""Correlation from which a rate is certainly that of a position: of a body's and a floor's axes it is lower."""


def _upright(angle: FloatArray, rate: FloatArray, acceleration: FloatArray, actions: FloatArray) -> list[Finding]:
    """Checks that 0 is upright: in acceleration = a torque + b sin(angle) + c rate + d, b must be positive."""
    good = np.isfinite(acceleration) & np.isfinite(rate)
    if int(good.sum()) < _MIN_ROWS or np.ptp(angle[good]) < 1.0:
        return []
    columns = np.column_stack([np.sin(angle), rate, np.ones_like(rate), actions])[good]
    wanted = acceleration[good]
    solution = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    explained = 1.0 - float(np.var(wanted - columns @ solution)) / max(float(np.var(wanted)), 1e-12)
    if explained < 0.5 or solution[0] > -1.0:
        return []
    text = f"gravity pulls towards angle 0 (acceleration = {solution[0]:.3g} sin(angle) + ...): 0 must be upright"
    return [finding("angle_zero", f"{text}; offset the angle by half a turn in a column map")]


def _steering(rows: RawRows, stretches: list[Stretch], system: System) -> list[Finding]:
    """Checks that the heading follows the steering: correlates d(yaw)/dt with speed tan(steer), up to 0.5 s later.

    It stays above 0.5 with lags, delays and offsets, but not with a wrong sign, another column or shuffled rows.
    """
    # A robot of the user's own may steer something else, and have neither speed nor heading.
    if not {"steer", "speed", "yaw"} <= {*system.action_names, *system.state_names}:
        return []
    speed, yaw = (rows.states[:, system.state_names.index(name)] for name in ("speed", "yaw"))
    steer = rows.actions[:, system.action_names.index("steer")]
    turning, asked = slopes_within(rows.t, yaw, stretches, _WINDOW), speed * np.tan(np.clip(steer, -1.5, 1.5))
    good = np.isfinite(turning) & np.isfinite(asked)
    moved = [float(np.std(values[good])) if good.any() else 0.0 for values in (steer, asked, turning)]
    if int(good.sum()) < _MIN_STEERED_ROWS or min(moved) < _MIN_STEERING:
        return []
    period = float(np.median(np.diff(rows.t[good])))
    shifts = range(0, max(1, round(_MAX_DELAY / max(period, 1e-6))) + 1, max(1, round(0.05 / max(period, 1e-6))))
    found = [_correlation(asked[: len(asked) - shift], turning[shift:]) for shift in shifts]
    best = max(found, key=abs)
    if best < -_DEPENDENT:
        text = f"the heading turns against steer (correlation {best:.2f}); flip steer or yaw in a column map"
        return [finding("opposite_sign", text)]
    if abs(best) < _UNRELATED:
        text = f"the heading does not turn as it is steered (correlation {best:.2f}, up to {_MAX_DELAY:g} s later)"
        return [finding("steer_inconsistent", f"{text}; check the column steer and that the rows belong together")]
    return []


def _turn_rate(rows: RawRows, stretches: list[Stretch], names: tuple[str, ...], measured: list[bool]) -> list[Finding]:
    """Checks the measured turn rate: a gyroscope may have the opposite sign, or degrees."""
    if "turn_rate" not in names or not measured[names.index("turn_rate")]:
        return []
    yaw, rate = (rows.states[:, names.index(name)] for name in ("yaw", "turn_rate"))
    known = rate[np.isfinite(rate)]
    if len(known) < _MIN_ROWS or float(known.std()) < _MIN_STEERING:
        return []
    return _scale("turn_rate", "yaw", rate, slopes_within(rows.t, yaw, stretches, _WINDOW))


def _correlation(one: FloatArray, other: FloatArray) -> float:
    good = np.isfinite(one) & np.isfinite(other)
    if int(good.sum()) < _MIN_ROWS or not (np.ptp(one[good]) > 0 and np.ptp(other[good]) > 0):
        return 0.0
    return float(np.corrcoef(one[good], other[good])[0, 1])


def _car(rows: RawRows, stretches: list[Stretch], names: tuple[str, ...], speed_measured: bool) -> list[Finding]:
    x, y, yaw, speed = (rows.states[:, names.index(name)] for name in ("x", "y", "yaw", "speed"))
    along_x, along_y = slopes_within(rows.t, x, stretches, _WINDOW), slopes_within(rows.t, y, stretches, _WINDOW)
    course_speed = np.hypot(along_x, along_y)
    moving = np.isfinite(course_speed)
    moving &= course_speed > max(0.05, 0.1 * float(np.quantile(course_speed[moving], 0.9)) if moving.any() else 0.0)
    if int(moving.sum()) < _MIN_ROWS:
        return []
    sign = np.where(speed[moving] < 0.0, -1.0, 1.0) if speed_measured else 1.0
    found = _scale("speed", "position", np.abs(speed), course_speed) if speed_measured else []
    velocity = np.asarray(sign * (along_x + 1j * along_y)[moving], dtype=np.complex128)
    return found + _direction(velocity, yaw[moving])


def _scale(name: str, source: str, measured: FloatArray, moved: FloatArray) -> list[Finding]:
    """Compares a measured rate with the derivative of its quantity: gain = sum(moved measured) / sum(measured^2).

    Noise in the measured rate lowers this gain and raises gain / correlation^2; the true gain lies between the two.
    """
    good = np.isfinite(moved) & np.isfinite(measured)
    measured, moved = measured[good], moved[good]
    power = float(measured @ measured)
    if len(measured) < _MIN_ROWS or power == 0.0 or not np.any(moved):
        return []
    gain = float(measured @ moved) / power
    correlation = float(measured @ moved) / float(np.sqrt(power * (moved @ moved)))
    if correlation < -0.7:
        text = (
            f"{name} has the opposite sign of the change of {source} (correlation {correlation:.2f}); flip one of them"
        )
        return [finding("opposite_sign", text)]
    highest = gain / max(correlation, 1e-9) ** 2
    if correlation < 0.7 or (gain <= 1.0 + _SCALE_TOLERANCE and highest >= 1.0 - _SCALE_TOLERANCE):
        return []
    gain = float(np.sqrt(gain * highest))
    ratio = f"the change of {source} is {gain:.4g} times {name} (correlation {correlation:.2f})"
    for factor, unit in _MISTAKES:
        if abs(gain / factor - 1.0) < 0.1:
            return [finding("unit_mistake", f"{ratio}, as if {name} were in {unit}; name the unit in a column map")]
    return [finding("scale_mismatch", f"{ratio}; check units, wheel radius or gear ratio")]


def _direction(velocity: NDArray[np.complex128], yaw: FloatArray) -> list[Finding]:
    """Compares the direction of motion with the heading.

    direct = mean exp(i (course - yaw)), mirrored = mean exp(i (course + yaw)), weighted by speed: near 1 in absolute
    value if the two agree up to a constant angle, directly or mirrored.
    """
    weight = float(np.abs(velocity).sum())
    direct = complex(np.sum(velocity * np.exp(-1j * yaw))) / weight
    mirrored = complex(np.sum(velocity * np.exp(1j * yaw))) / weight
    both_ways = abs(complex(np.sum(velocity**2 / np.abs(velocity) * np.exp(-2j * yaw)))) / weight
    if abs(direct) >= 0.8 or abs(direct) >= abs(mirrored) - 0.1:
        if abs(direct) >= 0.8 and abs(np.angle(direct)) > 0.5:
            degrees = np.degrees(np.angle(direct))
            text = (
                f"the direction of motion is turned by {degrees:.0f} degrees against yaw (agreement {abs(direct):.2f})"
            )
            return [finding("yaw_offset", f"{text}; offset yaw in a column map, or the car drives backwards")]
        if abs(direct) < 0.8 and both_ways < 0.8:
            text = f"yaw does not follow the direction of motion (agreement {abs(direct):.2f}, 1 is perfect)"
            return [finding("yaw_inconsistent", f"{text}; check the columns x, y and yaw and their units")]
        return []
    if abs(mirrored) < 0.8:
        text = f"yaw does not follow the direction of motion (agreement {abs(direct):.2f}, 1 is perfect)"
        return [finding("yaw_inconsistent", f"{text}; check the columns x, y and yaw and their units")]
    return [_mirrored_finding(direct, mirrored)]


def _mirrored_finding(direct: complex, mirrored: complex) -> Finding:
    turned = abs(float(np.degrees(np.angle(mirrored))))
    agreement = f"agreement {abs(mirrored):.2f} mirrored, {abs(direct):.2f} as it is"
    if 45.0 < turned < 135.0:
        text = f"x and y look swapped, or yaw is a compass heading ({agreement}); correct it in a column map"
        return finding("swapped_columns", text)
    wrong = "yaw or y" if turned <= 45.0 else "x"
    return finding("opposite_sign", f"{wrong} seems to have the opposite sign ({agreement}); flip it in a column map")
