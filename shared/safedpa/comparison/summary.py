"""Summary of a comparison: sentences for the user, and the JSON document."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from safedpa.comparison.comparison import PREDICTORS, Comparison
from safedpa.comparison.rollout_error import RolloutError
from safedpa.comparison.where import Bin, Factor

# A state stands out in a run if its error is this multiple of the median over the runs.
_ODD = 2.0
# Scaled errors below this are too small to mention.
_NEGLIGIBLE = 0.01
# Relative increase from which an error is reported as worse: less is within the scatter between windows.
_RELATIVE_INCREASE = 0.05
# State and run pairs that a sentence names: more would not be read.
_REPORTED = 4
_POSITION_AND_TIME = ("position", "time")


def most_influential_factor(comparison: Comparison) -> Factor:
    """Returns the variable on which the error depends most.

    Position and time can be proxies for anything that happened there. They are named only if they explain clearly more
    (1.5 times and 0.05 more) than every state and action.
    """
    physical = [item for item in comparison.factors if item.kind not in _POSITION_AND_TIME]
    best = max(physical, key=lambda item: item.explained)
    other = comparison.factors[0]
    clearly = other.explained > 1.5 * max(best.explained, 0.0) + 0.05
    return other if clearly else best


def worst_bins(comparison: Comparison) -> list[Bin]:
    """Returns all bins of all variables, the largest error first."""
    return sorted((b for item in comparison.factors for b in item.bins), key=lambda b: -b.error)


def where_sentence(comparison: Comparison) -> str:
    """Returns a sentence: where the model fails, and by how much more than on average."""
    if not (comparison.error.scale > 0).any():
        return "Nothing changes in these runs: there is nothing to predict."
    factor = most_influential_factor(comparison)
    worst = max(factor.bins, key=lambda item: item.error)
    average = comparison.error.value
    if not average > 1e-6:
        return "The model predicts these runs exactly."
    if not math.isfinite(average):
        return "The model's predictions diverge in more than 5 % of the windows."
    if factor.explained < 0.02 or worst.ratio < 1.2:
        return f"The model's error is similar everywhere: in no range is it far above the average of {average:.2f}."
    return (
        f"The model fails most at {bin_text(worst)}: its error there is {worst.error:.2f}, {worst.ratio:.1f} times the "
        f"average of {average:.2f} ({_percent(worst.share)} of the squared error "
        f"in {_percent(worst.samples / len(comparison.windows))} of the windows)."
    )


def state_sentence(comparison: Comparison) -> str:
    """Returns a sentence: which state is predicted worst, and to which side."""
    error = comparison.error
    states = comparison.windows.system.state
    moved = [index for index, size in enumerate(error.scale) if size > 0]
    if not moved:
        return "No state changes."
    worst = max(moved, key=lambda index: error.per_state[index])
    rms = error.per_state[worst] * error.scale[worst]
    median = float(np.median(comparison.errors[:, worst]))
    unit, side = states[worst].unit, "high" if median > 0 else "low"
    biased = abs(median) > 0.3 * rms > 0.0
    bias = f"median {abs(median):.3g} {unit} too {side}" if biased else "no bias to one side"
    return (
        f"The state predicted worst is {states[worst].name}: off by {rms:.3g} {unit} after {comparison.horizon:g} s "
        f"({bias}), {error.per_state[worst]:.2f} times as much as it usually changes."
    )


def run_sentence(comparison: Comparison) -> str:
    """Returns a sentence: in which run a state is far worse than elsewhere, or worse than no change; else empty."""
    rows = [(run, name, value) for run in comparison.runs for name, value in run.per_state.items()]
    if len(comparison.runs) < 2:
        return ""
    worse_than_no_change = [
        (run, name, value) for run, name, value in rows if value > max(run.no_change[name], _NEGLIGIBLE)
    ]
    usual = {name: float(np.median([value for _, other, value in rows if other == name])) for _, name, _ in rows}
    odd = [item for item in rows if item[2] > _ODD * usual[item[1]] and item[2] > _NEGLIGIBLE]
    parts = []
    if odd:
        run, name, value = max(odd, key=lambda item: item[2] / max(usual[item[1]], 1e-12))
        parts.append(
            f"{name} is far worse in {run.name} than in other runs: {value:.2f}, where the median is {usual[name]:.2f}"
        )
    if worse_than_no_change and len(worse_than_no_change) < len(rows):
        reported = ", ".join(
            f"{name} in {run.name} ({value:.2f})" for run, name, value in worse_than_no_change[:_REPORTED]
        )
        more = f" and {len(worse_than_no_change) - _REPORTED} more" if len(worse_than_no_change) > _REPORTED else ""
        parts.append(f"worse than predicting no change: {reported}{more}")
    return (parts[0][0].upper() + "; ".join(parts)[1:] + ".") if parts else ""


def worse_sentence(before: Comparison, after: Comparison) -> str:
    """Returns a sentence: which states one model predicts worse than another, on the same windows."""
    pairs = [
        (run.name, name, old.per_state[name], value)
        for old, run in zip(before.runs, after.runs, strict=True)
        for name, value in run.per_state.items()
        if name in old.per_state
    ]
    worse = [
        item for item in pairs if item[3] > (1.0 + _RELATIVE_INCREASE) * item[2] and item[3] > item[2] + _NEGLIGIBLE
    ]
    change = f"The mean error goes from {before.error.value:.3g} to {after.error.value:.3g}"
    if not worse:
        return f"{change}; no state gets worse in any run."
    worse.sort(key=lambda item: item[2] - item[3])
    reported = ", ".join(f"{name} in {run} ({old:.2g} to {new:.2g})" for run, name, old, new in worse[:_REPORTED])
    more = f" and {len(worse) - _REPORTED} more" if len(worse) > _REPORTED else ""
    return f"{change}; worse: {reported}{more}."


def naive_sentence(comparison: Comparison) -> str:
    """Returns a sentence that compares the model with the naive predictors."""
    errors = {name: item.value for name, item in comparison.horizons[-1].errors.items()}
    if not (comparison.error.scale > 0).any():
        return "All predictors are equal on these runs."
    beaten = [name for name in PREDICTORS[1:] if errors["model"] < errors[name]]
    verdict = {2: "better than both", 0: "worse than both"}.get(len(beaten)) or "better than one of them only"
    return (
        f"After {comparison.horizon:g} s the model's error is {errors['model']:.2f}; predicting no change gives "
        f"{errors['no_change']:.2f}, constant velocity {errors['constant_velocity']:.2f}: {verdict}."
    )


def bin_text(item: Bin, longest: int = 80) -> str:
    """Returns a bin as text, such as "speed 2 to 2.5 m/s"; names of runs are cut to ``longest`` characters."""
    unit = "" if item.unit == "1" else f" {item.unit}"
    run = f" of {shortened(item.run, longest)}" if item.run else ""
    return f"{item.variable} {item.low:.3g} to {item.high:.3g}{unit}{run}"


def shortened(name: str, longest: int) -> str:
    """Returns the last ``longest`` characters of a name, with a mark if it was cut: names differ at their end."""
    return name if len(name) <= longest else "…" + name[1 - longest :]


def as_json(comparison: Comparison) -> dict[str, Any]:
    """Returns the document of ``compare --json``; values that are not finite become null."""
    windows = comparison.windows
    names = windows.system.state_names
    texts = (where_sentence, state_sentence, naive_sentence, run_sentence)
    document = {
        "format": 1,
        "robot": windows.system.name,
        "effects": [item.name for item in comparison.model.effects],
        "parameters": {path: setting.value for path, setting in comparison.model.settings.items()},
        "horizon": comparison.horizon,
        "windows": len(windows),
        "summary": [text for sentence in texts if (text := sentence(comparison))],
        "error": comparison.error.value,
        "per_state": dict(zip(names, comparison.error.per_state, strict=True)),
        "scale": dict(zip(names, comparison.error.scale, strict=True)),
        "naive": {name: _error(names, comparison.horizons[-1].errors[name]) for name in PREDICTORS[1:]},
        "horizons": [
            {"seconds": item.seconds, **{name: _error(names, item.errors[name]) for name in PREDICTORS}}
            for item in comparison.horizons
        ],
        # Only the bins of time name a run.
        "where": [
            {key: value for key, value in vars(item).items() if (key, value) != ("run", None)}
            for item in worst_bins(comparison)
        ],
        "explained": {item.variable: item.explained for item in comparison.factors},
        "place": [vars(cell) for cell in comparison.cells],
        "runs": [vars(run) for run in comparison.runs],
        "data_quality": [{"run": run, **vars(finding)} for run, finding in comparison.findings],
    }
    return {key: as_plain(value) for key, value in document.items()}


def as_plain(value: Any) -> Any:
    """Converts data classes, tuples and NumPy scalars to JSON types; values that are not finite become null."""
    if hasattr(value, "__dataclass_fields__"):
        return as_plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): as_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [as_plain(item) for item in value]
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        return value
    # Duck typing covers NumPy scalars; JSON has no infinity or NaN.
    number = int(value) if hasattr(value, "__index__") else float(value)
    return number if math.isfinite(number) else None


def _error(names: tuple[str, ...], error: RolloutError) -> dict[str, Any]:
    per_state, rms = (
        dict(zip(names, values, strict=True)) for values in (error.per_state, error.per_state * error.scale)
    )
    return {"error": error.value, "per_state": per_state, "rms": rms}


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.01 else f"{100 * share:.1f} %"
