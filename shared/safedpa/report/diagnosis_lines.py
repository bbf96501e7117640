"""A diagnosis as lines of text: what ``safedpa diagnose`` and ``print(diagnosis)`` show."""

from __future__ import annotations

import math

from safedpa.diagnosis.report_schema import FittedValue, Report, as_document
from safedpa.report.diagnosis_story import closest_rows, deviation_text, report_text, rounded

_BAR = 40
"""Characters of the longest bar."""
_WORSE = 3
"""Number of states that got worse that are named; the report lists all."""
_FINDINGS = 6
"""Number of findings about the data that are named; the report lists all."""


def story_lines(report: Report) -> list[tuple[str, str]]:
    """Returns the diagnosis as lines with styles: verdict, largest error, missing effects, rest, next drive."""
    story = report_text(as_document(report))
    lines = [(_verdict(report, story.lead), "bold")]
    worst = next((item for item in report.where if math.isfinite(item["ratio"])), None)
    if worst is not None:
        unit = "" if worst["unit"] == "1" else f" {worst['unit']}"
        place = f"{worst['variable']} {worst['low']:.3g} to {worst['high']:.3g}{unit}"
        lines.append((f"Worst at {place}: {worst['ratio']:.1f} times the average error.", ""))
    lines += [(f"  {line}", "green") for line in _found(report)]
    lines += _bars(report)
    for lost in report.worse[:_WORSE]:
        text = f"  {lost.state} got worse in {lost.run}: {lost.before:.3g} to {lost.after:.3g}, though the mean fell"
        lines.append((text, "yellow"))
    lines += [
        (f"  Cannot be distinguished: {name} and {', '.join(others)}.", "yellow") for name, others in _groups(report)
    ]
    if report.unexplained is not None and report.unexplained.depends_on:
        lines.append((story.remains, "yellow"))
        lines.append((f"  {story.formula_title}: {report.unexplained.expression}", "yellow"))
        lines.append((f"  {story.formula_note}", "dim"))
    for effect, numbers, fall, drive in closest_rows(as_document(report)):
        off = f"; would reduce the error by {fall}" if fall else ""
        lines.append((f"  Likely, not proven: {effect} ({numbers}{off})", "yellow"))
        lines += [(f"    To find out, drive: {drive}.", "cyan")] if drive else []
    if report.next_experiment is not None:
        item = report.next_experiment
        lines.append((f"Next: {item.manoeuvre}; {item.why}.", "cyan"))
    messages = list(dict.fromkeys(str(item["message"]) for item in report.data_quality))
    lines += [(f"  data: {message}", "dim") for message in messages[:_FINDINGS]]
    return lines


def _verdict(report: Report, lead: str) -> str:
    if report.verdict == "unexplained" and report.unexplained is not None and not report.unexplained.depends_on:
        return f"No verdict: {report.unexplained.expression}."
    explained = report.remainder is None or not report.remainder.sentence
    if report.verdict == "unexplained" and report.added and explained:
        return f"No verdict: the model predicts badly with every effect added ({', '.join(report.added)} fit best)."
    return lead


def _found(report: Report) -> list[str]:
    lines = []
    for name in report.added:
        own = {path.split(".")[1]: item for path, item in report.parameters.items() if path.split(".")[0] == name}
        note = " (within two deviations of no effect)" if name in report.uncertain else ""
        lines.append(f"{name}: {', '.join(value_text(key, item) for key, item in own.items())}{note}")
        lines += [f"  {item.sentence}" for item in report.conditions if item.effect == name]
    return lines


def _bars(report: Report) -> list[tuple[str, str]]:
    first = report.stages[0].heldout_error
    lines = []
    for number, stage in enumerate(report.stages):
        before = report.stages[number - 1].effects if number else ()
        name = " ".join(f"+ {own}" for own in stage.effects if own not in before) or "given model"
        length = round(_BAR * min(stage.heldout_error / first, 1.0)) if first > 0 else 0
        runs = f" ({stage.runs_improved} runs better)" if stage.runs_improved else ""
        lines.append((f"  {name:24.24} {'█' * length:{_BAR}} {stage.heldout_error:.3g}{runs}", ""))
    return lines


def _groups(report: Report) -> list[tuple[str, tuple[str, ...]]]:
    ambiguous = [item for item in report.candidates if item.decision == "accepted" and item.indistinguishable_from]
    return [(item.effect, item.indistinguishable_from) for item in ambiguous]


def value_text(name: str, value: FittedValue) -> str:
    """Returns a fitted value as text: coefficient 0.121 +- 0.003 1/m."""
    spread = "" if value.std is None else f" +- {deviation_text(value.std)}"
    return f"{name} {rounded(value.value, value.std)}{spread}" + ("" if value.unit == "1" else f" {value.unit}")
