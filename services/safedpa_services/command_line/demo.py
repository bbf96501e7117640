"""``safedpa demo``: a fault during a drive is diagnosed and the model corrected, in two minutes."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError, SafedpaError
from safedpa.extras import missing, need
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.command_line.options import PATH, as_json_option, recordings_option
from safedpa_services.command_line.up import default_options, make_plan, run_plan
from safedpa_services.plain_output import print_plain

if TYPE_CHECKING:
    from safedpa.bus.service.process import StopSignal
    from safedpa_services.supervisor.child import Child
    from safedpa_services.supervisor.demo_narrator import DemoNarrator
    from safedpa_services.supervisor.plan import Plan
    from safedpa_services.supervisor.run_monitor import RunMonitor

_FAULT_SECONDS = 25.0
"""Robot time of the fault: the diagnosis learns the usual error during the first 20 s. On a busy machine it takes
longer, and the fault waits for it."""
_TIMEOUT_SECONDS = 125.0
"""With --yes: robot time from the fault, or from the start, in which the model must have been corrected."""
_CHANGE_SECONDS = 255.0
"""The same from the end of the newest search: three attempts of a change, 60 s for its model and 25 s for its offer. A
search itself has a limit in processor time: a busy machine only delays it."""
_MODEL, _CHANGE = "car_measured", "steering_offset"
_BAR = 40


@click.command()
@click.option("--yes", is_flag=True, help="accept the diagnosis' proposal instead of waiting for your click")
@click.option("--seed", type=click.IntRange(0), default=2, show_default=True, help="scene: obstacles, start, goals")
@click.option("--headless", is_flag=True, help="serve no page; requires --yes")
@click.option("--no-browser", is_flag=True, help="do not open a browser; the terminal shows the address of the page")
@click.option("--picture", type=PATH, metavar="FILE.png", help="take a screenshot of the page at the end (Chromium)")
@recordings_option
@as_json_option
def command(**options: Any) -> None:
    """See a fault diagnosed and corrected during a drive.

    Takes under two minutes. The car drives in real time behind the safety filter, and the live page opens. After 25 s
    the steering linkage is bent by 0.08 rad, which no model knows. The diagnosis detects the error, searches for the
    missing effect and proposes it; a click on Accept (or --yes) corrects the model while the car drives. At the end the
    command prints by how much the error fell, and writes a report.
    """
    from safedpa.bus.service.process import StopSignal

    _check(options)
    if not options["as_json"]:
        print_plain("Starting a simulated car, its services and the live page: 5 to 15 s. Ctrl-C ends everything.")
    stop = StopSignal()
    with make_plan(_drive_options(options)) as plan:
        stop.listen_to_signals()
        shown = replace(plan.with_page_alone(), awaits_diagnosis=True, change_on_word=True)
        demonstration = _DemoRun(shown, stop, options)
        summary = run_plan(demonstration.plan, stop, demonstration.shown)
    result = demonstration.result(summary)
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _print_result(result)
    if result["failure"]:
        raise SafedpaError(result["failure"])


def _drive_options(options: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of ``safedpa up`` for the demo."""
    own = {
        "robot": DEFAULT_ROBOT,
        "model": _MODEL,
        "change": _CHANGE,
        "change_after": _FAULT_SECONDS,
        "diagnosis": True,
    }
    return {**default_options(), **own, "seed": options["seed"], "headless": options["headless"], "out": options["out"]}


def _check(options: dict[str, Any]) -> None:
    need("sim", what="the simulated robot", instead="diagnose recordings with 'safedpa diagnose'")
    if options["headless"]:
        if not options["yes"] or options["picture"] is not None:
            raise InputError(
                "--headless: got no page to click or to take a picture of; add --yes, and leave out --picture"
            )
    elif missing("workbench"):
        need("workbench", what="the live page", instead="leave it out with --headless --yes")
    if options["picture"] is not None:
        from safedpa_services.workbench.screenshots import find_browser

        if not options["picture"].absolute().parent.is_dir():
            raise InputError(f"--picture {options['picture']}: its folder does not exist; create it")
        find_browser()


class _DemoRun:
    """A run as in ``safedpa up``, shown as a narration instead of a table of processes."""

    def __init__(self, plan: Plan, stop: StopSignal, options: dict[str, Any]) -> None:
        self.plan, self._stop, self._options = plan, stop, options
        self.story: DemoNarrator | None = None
        self._opened = False
        self._released_at: float | None = None
        """Robot time [s] at which the fault was released; None: not yet."""
        self._searched_at = -_CHANGE_SECONDS
        """Robot time [s] at which a search was last in progress."""
        self._picture: threading.Thread | None = None
        self._picture_error = ""

    @contextmanager
    def shown(self, watch: RunMonitor, children: Sequence[Child]) -> Iterator[Callable[[], None]]:
        """Yields the function that the supervisor calls in each turn."""
        from safedpa_services.supervisor.demo_narrator import DemoNarrator
        from safedpa_services.supervisor.log_warnings import LogWarnings

        def report_progress(line: str) -> None:
            if not self._options["as_json"]:
                print_plain(f"{0.0 if watch.state is None else watch.state.robot_time:5.0f} s  {line}")

        warnings = LogWarnings(children, self.plan.folder, notices=watch.notices)
        self.story = story = DemoNarrator(watch.bus, watch.robot, report_progress, self._options["yes"])
        report_progress(
            f"a car drives behind its filter; after {_FAULT_SECONDS:.0f} s its steering is bent, which no model knows"
        )

        def turn() -> None:
            warnings.look()
            story.look(watch)
            self._release(watch, children[0])
            self._open(report_progress)
            if story.done and self._picture_is_done():
                self._stop.set("the demo is over")
            elif self._options["yes"] and story.summary.taken is None and self._is_late(watch):
                self._stop.set("the model was not corrected")

        yield turn

    def _release(self, watch: RunMonitor, robot: Child) -> None:
        """Lets the fault occur once the diagnosis knows the usual error."""
        if self._released_at is None and watch.finding is not None and watch.finding.stage == "watching":
            self._released_at = _clock(watch)
            robot.signal()

    def _is_late(self, watch: RunMonitor) -> bool:
        if watch.finding is not None and watch.finding.stage == "searching":
            self._searched_at = _clock(watch)
        began = max(self._released_at or 0.0, _FAULT_SECONDS)
        return _clock(watch) > max(began + _TIMEOUT_SECONDS, self._searched_at + _CHANGE_SECONDS)

    def _open(self, report_progress: Callable[[str], None]) -> None:
        from safedpa_services.supervisor.screen import answers
        from safedpa_services.web.browser import show, shown_address

        address = self.plan.workbench_address
        if not address or self._opened or not answers(address):
            return
        self._opened = True
        shown = shown_address(address, self.plan.folder, is_terminal=sys.stdout.isatty())
        report_progress(f"live page: {shown}")
        if not (self._options["no_browser"] or self._options["as_json"]):
            show(address)

    def _picture_is_done(self) -> bool:
        """Takes the picture on a thread, if one is wanted; returns whether that is done."""
        from safedpa_services.workbench.screenshots import take_screenshot

        if self._options["picture"] is None:
            return True
        if self._picture is None:

            def work() -> None:
                try:
                    take_screenshot(self.plan.workbench_address, self._options["picture"])
                except SafedpaError as error:
                    self._picture_error = str(error)

            self._picture = threading.Thread(target=work, daemon=True)
            self._picture.start()
        return not self._picture.is_alive()

    def result(self, summary: dict[str, Any]) -> dict[str, Any]:
        """Returns the results as a JSON document; writes the report if the model was corrected."""
        story = self.story
        if story is None:
            raise SafedpaError("ended before the robot was started; nothing was driven")
        facts = story.document()
        report = _report(story, summary, self.plan.folder) if story.summary.taken is not None and story.report else ""
        return {
            "seed": self._options["seed"],
            "changed": summary.get("changed"),
            **facts,
            "effect": _accepted_effect(story.models) or facts["effect"],
            **{
                name: summary[name]
                for name in ("robot_seconds", "goals_reached", "collisions", "standstills", "recording")
            },
            "report": report,
            "picture": str(self._options["picture"]) if self._picture is not None and not self._picture_error else "",
            "failure": self._picture_error or _failure(story, summary),
        }


def _accepted_effect(models: Sequence[str]) -> str:
    """Returns the effect that the model has after the change and not before; a user may accept any candidate."""
    from safedpa.dynamics.model_file import parse_model

    before, after = (
        ({item.name for item in parse_model(text).effects} for text in models[:2]) if models[1:] else ((), ())
    )
    return ", ".join(sorted(set(after) - set(before)))


def _clock(watch: RunMonitor) -> float:
    return 0.0 if watch.state is None else watch.state.robot_time


def _failure(story: DemoNarrator, summary: dict[str, Any]) -> str:
    """Returns why the demo failed, as one line; empty if it succeeded."""
    from safedpa_services.supervisor.demo_narrator import WANTED_FALL

    if story.summary.taken is None:
        drove = f"drove for {summary['robot_seconds']:.0f} s"
        return f"demo: {drove}, and the model was not changed; try again, with another --seed for example"
    if story.summary.fall is None and story.done:
        return "demo: the diagnosis reported no error of the corrected model; see diagnosis.log next to the recording"
    if story.summary.fall is None:
        return "demo: ended before the error of the corrected model was measured; let it run 20 s after Accept"
    if story.summary.fall < WANTED_FALL:
        return f"demo: the error fell by {100 * story.summary.fall:.0f} %, wanted {100 * WANTED_FALL:.0f} %"
    if summary.get("recording_error"):
        return f"demo: the recording {summary.get('recording')} is incomplete: {summary['recording_error']}"
    return ""


def _report(story: DemoNarrator, summary: dict[str, Any], folder: Path) -> str:
    """Writes report.html and the corrected model into the folder of the drive; returns the path of the report."""
    from safedpa.dynamics.model_file import parse_model
    from safedpa.limits import parse_json
    from safedpa.records import load_run
    from safedpa.records.run import Stretch
    from safedpa.report.diagnosis_page import write_report

    if len(story.models) < 2 or summary.get("changed") is None or story.summary.taken is None:
        return ""
    models = [parse_model(text) for text in story.models[:2]]
    (folder / "model.toml").write_text(story.models[1], encoding="utf-8")
    run = load_run(summary["recording"], models[0].system)
    rows = [k for k, t in enumerate(run.t) if summary["changed"] <= t <= story.summary.taken]
    parts = [
        Stretch(max(part.start, rows[0]), min(part.stop, rows[-1] + 1))
        for part in run.stretches
        if part.start <= rows[-1] and part.stop > rows[0]
    ]
    changed = replace(run, name="from the change to Accept", stretches=tuple(parts))
    return str(write_report(parse_json(story.report), [changed], models, folder, "the demonstration"))


def _print_result(result: dict[str, Any]) -> None:
    if result["fall"] is not None:
        before, after = result["error_before"], result["error_after"]
        click.echo("Error over one second of driving:")
        for name, value in (("before", before), ("after", after)):
            length = max(1, round(_BAR * min(value / before, 1.0)))
            click.echo(f"  {name:8}{'█' * length:{_BAR}} {value:.3f}")
        click.echo(f"It fell by {100 * result['fall']:.0f} % with {result['effect']}.")
    for stand in result["standstills"]:
        print_plain(f"stationary for {stand['seconds']:.0f} s from {stand['from']:.1f} s on: {stand['reason']}")
    drove = f"{result['robot_seconds']:.0f} s, {result['goals_reached']} goals, {result['collisions']} collisions"
    click.echo(f"Drove for {drove}.")
    for name in ("report", "picture", "recording"):
        if result[name]:
            click.echo(f"{name.capitalize()}: {result[name]}")
