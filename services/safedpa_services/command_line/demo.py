"""``safedpa demo``: in two minutes from a bent steering to a model that knows it."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError, SafedpaError
from safedpa.extras import missing, need
from safedpa.robot import DEFAULT_ROBOT
from safedpa_services.command_line.up import default_options, driven, planned
from safedpa_services.lines import print_plain

if TYPE_CHECKING:
    from safedpa.bus.service.process import StopSignal
    from safedpa_services.supervisor.child import Child
    from safedpa_services.supervisor.plan import Plan
    from safedpa_services.supervisor.story import DemoNarrator
    from safedpa_services.supervisor.watch import RunMonitor

_AFTER = 25.0
"""s of driving before the change: the first 20 teach the diagnosis what is usual."""
_LONGEST_UNASKED = 150.0
"""s by the robot's clock until which the model is to be corrected where no one is waited for."""
_MODEL, _CHANGE = "car_measured", "steering_offset"
_BAR = 40


@click.command()
@click.option("--yes", is_flag=True, help="accept what the diagnosis proposes, instead of waiting for your click")
@click.option("--seed", type=click.IntRange(0), default=2, show_default=True, help="scene: obstacles, start, goals")
@click.option("--headless", is_flag=True, help="serve no page; wants --yes")
@click.option("--no-browser", is_flag=True, help="open no browser; the address of the page stands in the terminal")
@click.option(
    "--picture", type=click.Path(path_type=Path), metavar="FILE.png", help="photograph the page at the end (Chromium)"
)
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs"), show_default=True, help="for recordings")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
def command(**options: Any) -> None:
    """A car drives, its steering is bent, the diagnosis finds out, you accept, the error falls. Under two minutes.

    Drives in real time behind the safety filter and opens the live page. After 25 s the steering linkage is bent by
    0.08 rad, and no model is told. The diagnosis notices, searches for what the model lacks and proposes it; a click on
    Accept (or --yes) corrects the model while the car drives. At the end: the fall of the error, and a report.
    """
    from safedpa.bus.service.process import StopSignal

    _check(options)
    stop = StopSignal()
    with planned(_asked(options)) as plan:
        stop.listen_to_signals()
        demonstration = _DemoRun(plan.with_page_alone(), stop, options)
        summary = driven(demonstration.plan, stop, demonstration.shown)
    result = demonstration.result(summary)
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _print_result(result)
    if result["failure"]:
        raise SafedpaError(result["failure"])


def _asked(options: dict[str, Any]) -> dict[str, Any]:
    """Options of the drive."""
    own = {"robot": DEFAULT_ROBOT, "model": _MODEL, "change": _CHANGE, "change_after": _AFTER, "diagnosis": True}
    return {**default_options(), **own, "seed": options["seed"], "headless": options["headless"], "out": options["out"]}


def _check(options: dict[str, Any]) -> None:
    need("sim", what="the simulated robot", instead="diagnose recordings with 'safedpa diagnose'")
    if options["headless"]:
        if not options["yes"] or options["picture"] is not None:
            raise InputError("--headless: got no page to click or to photograph; wanted --yes, and no --picture")
    elif missing("workbench"):
        need("workbench", what="the live page", instead="go without it by --headless --yes")
    if options["picture"] is not None:
        from safedpa_services.workbench.pictures import browser_at_hand

        if not options["picture"].absolute().parent.is_dir():
            raise InputError(f"--picture {options['picture']}: its folder does not exist; create it")
        browser_at_hand()


class _DemoRun:
    """The loop of ``up``, with a story told about it in place of its table of processes."""

    def __init__(self, plan: Plan, stop: StopSignal, options: dict[str, Any]) -> None:
        self.plan, self._stop, self._options = plan, stop, options
        self.story: DemoNarrator | None = None
        self._opened = False
        self._picture: threading.Thread | None = None
        self._trouble = ""

    @contextmanager
    def shown(self, watch: RunMonitor, services: Sequence[Child], robot: Child) -> Iterator[Callable[[], None]]:
        """Yields what the supervisor calls in each turn."""
        from safedpa_services.supervisor.story import DemoNarrator
        from safedpa_services.supervisor.warnings import Warnings

        def report_progress(line: str) -> None:
            if not self._options["as_json"]:
                print_plain(f"{0.0 if watch.state is None else watch.state.robot_time:5.0f} s  {line}")

        warnings = Warnings((robot, *services), self.plan.folder)
        self.story = story = DemoNarrator(watch.bus, watch.robot, report_progress, self._options["yes"])
        report_progress(
            f"a car drives behind its filter; after {_AFTER:.0f} s its steering is bent, and no model is told"
        )

        def turn() -> None:
            warnings.look()
            story.look(watch)
            self._open(report_progress)
            if story.done and self._photographed():
                self._stop.set("the story is told")
            elif self._options["yes"] and story.reported.taken is None and _clock(watch) > _LONGEST_UNASKED:
                self._stop.set("the model was not corrected")

        yield turn

    def _open(self, report_progress: Callable[[str], None]) -> None:
        from safedpa_services.supervisor.screen import answers
        from safedpa_services.web.browser import show

        address = self.plan.workbench_address
        if not address or self._opened or not answers(address):
            return
        self._opened = True
        report_progress(f"live page: {address}")
        if not (self._options["no_browser"] or self._options["as_json"]):
            show(address)

    def _photographed(self) -> bool:
        """Whether the picture is there, or none is wanted; begins it alongside the loop."""
        from safedpa_services.workbench.pictures import photograph

        if self._options["picture"] is None:
            return True
        if self._picture is None:

            def work() -> None:
                try:
                    photograph(self.plan.workbench_address, self._options["picture"])
                except SafedpaError as error:
                    self._trouble = str(error)

            self._picture = threading.Thread(target=work, daemon=True)
            self._picture.start()
        return not self._picture.is_alive()

    def result(self, summary: dict[str, Any]) -> dict[str, Any]:
        """The story and the drive as one document; writes the report where there is something to report."""
        story = self.story
        if story is None:
            raise SafedpaError("ended before the robot was started; nothing was driven")
        reported = story.document()
        report = _report(story, summary, self.plan.folder) if story.reported.taken is not None and story.report else ""
        return {
            "seed": self._options["seed"],
            "changed": summary.get("changed"),
            **reported,
            **{
                name: summary[name]
                for name in ("robot_seconds", "goals_reached", "collisions", "standstills", "recording")
            },
            "report": report,
            "picture": str(self._options["picture"]) if self._picture is not None and not self._trouble else "",
            "failure": self._trouble or _failure(story, summary),
        }


def _clock(watch: RunMonitor) -> float:
    return 0.0 if watch.state is None else watch.state.robot_time


def _failure(story: DemoNarrator, summary: dict[str, Any]) -> str:
    """Why the story did not end well, in a line; empty where it did."""
    from safedpa_services.supervisor.story import WANTED_FALL

    if story.reported.taken is None:
        drove = f"drove for {summary['robot_seconds']:.0f} s"
        return f"demo: {drove}, and the model was not changed; say it again, perhaps with another --seed"
    if story.reported.fall is None:
        return "demo: ended before the error with the corrected model could be told; leave it 20 s after Accept"
    if story.reported.fall < WANTED_FALL:
        return f"demo: the error fell by {100 * story.reported.fall:.0f} %, wanted {100 * WANTED_FALL:.0f} %"
    return ""


def _report(story: DemoNarrator, summary: dict[str, Any], folder: Path) -> str:
    """report.html, and the models before and after, in the folder of the drive."""
    from dataclasses import replace

    from safedpa.dynamics.model_file import parse_model
    from safedpa.limits import parse_json
    from safedpa.records import load_run
    from safedpa.records.run import Stretch
    from safedpa.report.diagnosis_page import write_report

    if len(story.models) < 2 or summary.get("changed") is None or story.reported.taken is None:
        return ""
    models = [parse_model(text) for text in story.models[:2]]
    (folder / "model.toml").write_text(story.models[1], encoding="utf-8")
    run = load_run(summary["recording"], models[0].system)
    rows = [k for k, t in enumerate(run.t) if summary["changed"] <= t <= story.reported.taken]
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
        print_plain(f"stood for {stand['seconds']:.0f} s from {stand['from']:.1f} s on: {stand['reason']}")
    drove = f"{result['robot_seconds']:.0f} s, {result['goals_reached']} goals, {result['collisions']} collisions"
    click.echo(f"Drove for {drove}.")
    for name in ("report", "picture", "recording"):
        if result[name]:
            click.echo(f"{name.capitalize()}: {result[name]}")
