"""The first column: the robot and its prediction."""

from __future__ import annotations

from collections.abc import Callable

from nicegui import events, ui

from safedpa.diagnosis.summary import shortened
from safedpa_services.workbench.elements import action, escaped, named, panel, text
from safedpa_services.workbench.figures_path import curves_figure, excerpt_of, path_figure
from safedpa_services.workbench.look import Look
from safedpa_services.workbench.session import Session

__all__ = ["PathPanel"]


class PathPanel:
    """Path and states from a chosen start, measured and predicted."""

    def __init__(self, on_start: Callable[[int], None], on_worst: Callable[[], None]) -> None:
        self._on_start = on_start
        with panel(1, "The robot and its prediction"):
            self._where = text("", "quiet one-line")
            self._legend = ui.html(sanitize=False).classes("legend")
            self._path = (
                ui.plotly({"data": []}).classes("grow").props('role=img aria-label="Path, measured and predicted"')
            )
            self._curves = ui.plotly({"data": []}).classes("grow").props('role=img aria-label="States along time"')
            with ui.element("div").classes("row tight"):
                action("◀", lambda: self._move(-1), "←", hint="previous start")
                self._slider = named(ui.slider(min=0, max=1, value=0).props("dense"), "start of the prediction")
                self._slider.on("update:model-value", self._slid, throttle=0.12)
                action("▶", lambda: self._move(1), "→", hint="next start")
                action("Worst", on_worst, "w", hint="start with the largest error in the selection")

    def _slid(self, event: events.GenericEventArguments) -> None:
        self._on_start(int(event.args))

    def _move(self, by: int) -> None:
        self._on_start(int(self._slider.value) + by)

    def show(self, session: Session, look: Look) -> None:
        """Draws everything anew."""
        found = excerpt_of(session)
        said = f"{session.horizon:g} s ahead from {found.moment:.2f} s of {shortened(found.run, 22)}"
        self._where.set_content(escaped(said))
        self._where.props(f'title="{escaped(found.run)}"')
        self._legend.set_content(_legend(session, look))
        self._slider.props(f"max={len(session.comparison.windows) - 1}")
        self._slider.value = session.start
        path = path_figure(session, found, look)
        self._path.set_visibility(path is not None)
        if path is not None:
            self._path.update_figure(path)
        self._curves.update_figure(curves_figure(session, found, look))


def _legend(session: Session, look: Look) -> str:
    lines = [("measured", look.measured, "solid"), ("model", look.present, "solid")]
    if session.number:
        lines.append(("given model", look.given, "dashed"))
    if session.number > 1:
        lines.append(("between", look.between, "dotted"))
    return "".join(
        f'<span><i style="border-color:{colour};border-top-style:{style}"></i>{name}</span>'
        for name, colour, style in lines
    )
