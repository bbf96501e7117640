"""The fourth column: the held-out error of each version."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from safedpa_services.workbench.panels.elements import button, escaped, panel, text
from safedpa_services.workbench.session.candidate_cards import parameter_lines
from safedpa_services.workbench.session.session import Session


class ErrorReductionPanel:
    """Shows a bar for each version; a click on it shows that version in the other columns."""

    def __init__(
        self,
        on_look: Callable[[int], None],
        on_undo: Callable[[], Any],
        on_save: Callable[[], Any],
        on_remove: Callable[[str], Any],
    ) -> None:
        self._on_look, self._on_remove = on_look, on_remove
        with panel(4, "The error falls"):
            text("on data that the fit did not see", "quiet")
            self._stages = ui.element("ol").classes("stages").props('aria-label="versions of the model"')
            with ui.element("div").classes("bottom"):
                self._effects = ui.element("div").props('role=list aria-label="effects of the model"')
                self._numbers = ui.html(sanitize=False)
                self._states = ui.html(sanitize=False)
                self._message = text("", "quiet").props("aria-live=polite")
                self._warning = text("", "problem", "div")
                self._saved = text("", "note", "div").props("role=status aria-live=polite")
                with ui.element("div").classes("row"):
                    self._undo = button("Undo", on_undo, "u", hint="undo the last decision")
                    self._save = button("Save", on_save, "s", hint="write the model and its margin", main=True)

    def show_save_status(self, warning: str, saving: str, notice: str) -> None:
        """Shows a warning about Save, its present step, or its result."""
        for element, phrase in ((self._warning, warning), (self._saved, saving or notice)):
            element.set_visibility(bool(phrase))
            element.set_content(escaped(phrase))
        self._save.set_enabled(not saving)

    def show(self, session: Session) -> None:
        """Redraws the bars."""
        highest = max((version.error for version in session.versions), default=0.0)
        self._stages.clear()
        with self._stages:
            for number, version in enumerate(session.versions):
                pressed = number == (session.number if session.shown is None else session.shown)
                width = 100.0 * version.error / highest if highest > 0 else 0.0
                with ui.element("li"):
                    bar = ui.element("button").props(f"type=button aria-pressed={'true' if pressed else 'false'}")
                    bar.on("click", lambda _event, at=number: self._on_look(at))
                    with bar:
                        ui.html(_stage(version.label, version.error, width, number), sanitize=False)
        self._undo.set_enabled(bool(session.decisions))
        self._show_effects(session)
        numbers = parameter_lines(session.shown_version.values)
        lines = "".join(f"<div>{escaped(line)}</div>" for line in numbers)
        self._numbers.set_content(f'<div class="quiet">fitted parameters</div>{lines}' if numbers else "")
        self._states.set_content(_states(session))
        improved = session.shown_version.improved
        self._message.set_content(f"better in {improved.replace('/', ' of ')} recordings" if improved else "")

    def _show_effects(self, session: Session) -> None:
        """Lists the effects of the present version, each with a button that removes it."""
        doubtful = session.doubtful_effects()
        self._effects.clear()
        with self._effects:
            for item in session.present.model.effects:
                with ui.element("div").classes("row").props("role=listitem"):
                    text(item.name.replace("_", " "))
                    if item.name in doubtful:
                        text("within two deviations of no effect", "problem")
                    button("Remove", lambda name=item.name: self._on_remove(name), hint=f"remove {item.name}")


def _stage(label: str, error: float, width: float, number: int) -> str:
    colour = "given" if number == 0 else ""
    return (
        f'<span class="label"><span>{escaped(label.replace("_", " "))}</span>'
        f'<span class="value">{error:.3g}</span></span>'
        f'<div class="bar"><div class="{colour}" style="width:{width:.1f}%"></div></div>'
    )


def _states(session: Session) -> str:
    """Table with the error of each state, for the given and the shown version."""
    windows, scale = session.comparison.windows, session.comparison.error.scale
    first, now = session.versions[0].comparison.error, session.comparison.error
    rows = []
    for index, state in enumerate(windows.system.state):
        unit = "" if state.unit == "1" else f" {state.unit}"
        before, after = first.per_state[index] * scale[index], now.per_state[index] * scale[index]
        rows.append(f"<tr><td>{state.name}</td><td>{before:.2g}</td><td>{after:.2g}{unit}</td></tr>")
    head = "<tr><th>off by</th><th style='text-align:right'>given</th><th style='text-align:right'>now</th></tr>"
    return f'<table class="states">{head}{"".join(rows)}</table>'
