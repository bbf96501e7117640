"""``safedpa up``: runs the whole control loop of a simulated robot, each part as a process."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError, SafedpaError
from safedpa.extras import missing, need
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.command_line.names import SuggestingChoice, complete_models, complete_robots
from safedpa_services.command_line.options import PATH, GroupedCommand, as_json_option, recordings_option
from safedpa_services.plain_output import print_plain

if TYPE_CHECKING:
    from safedpa.bus.service.process import StopSignal
    from safedpa.dynamics import PhysicsModel
    from safedpa.systems.robots import Robot
    from safedpa_services.supervisor.certificate_store import CertificateStore
    from safedpa_services.supervisor.child import Child
    from safedpa_services.supervisor.plan import Plan
    from safedpa_services.supervisor.run_monitor import RunMonitor

    Display = Callable[[RunMonitor, Sequence[Child]], AbstractContextManager[Callable[[], None]]]


LOADS = ("none", "box", "chair", "large_chair")
TASKS = ("balance", "swing")
_ROBOT_SPECIFIC = (
    "load", "change", "laser", "people", "task", "wind", "wind_direction", "payload", "dry_friction", "force", "world",
)  # fmt: skip
"""Options that only some robots have, as declared by the robots."""
_RANGES = {
    "seconds": (0.0, 1e9, "0 (until Ctrl-C) or more"),
    "change_after": (0.0, 1e9, "0 seconds or more"),
    "robots": (1, 8, "1 to 8"),  # the dashboard has eight tabs
    "seed": (0, math.inf, "0 or more"),
    "people": (0, 12, "0 to 12"),  # as many fit into the field of the simulated car
    "wind": (0.0, 15.0, "0 to 15 m/s"),
    "wind_direction": (-360.0, 360.0, "-360 to 360 degrees"),
    "force": (0.0, 0.0149, "0 to 0.0149 N"),  # a stronger wind exceeds the thrust of the point robot
    "payload": (0.0, 10.0, "0 to 10 kg"),
    "dry_friction": (0.0, 10.0, "0 to 10 N m"),
}
"""Minimum, maximum and text of the options that are numbers."""
CHANGES = ("hitch", "headwind", "steering_offset")
_FIELDS_OF_PLAN = ("load", "change")
"""Of these, the options that are fields of ``Plan``; the others are passed to the robot's process unchanged."""
_SAME_IN_PLAN = (
    "robot", "name", "robots", "seconds", "seed", "rate", "lockstep", "change_after", "model", "settings", "margin",
    "perception", "fleet", "endpoint", "certificates",
)  # fmt: skip
"""Options that are fields of ``Plan`` without any change."""
_EXIT_CODE_INTERRUPTED = 130
"""128 + SIGINT, as shells report it."""
GROUPS = {
    "Which robot": ("robot", "robot_file", "name", "robots", "seed"),
    "The car": ("load", "change", "change_after"),
    "Any planar robot": ("laser", "people"),
    "The pendulum": ("task", "wind", "wind_direction", "payload", "dry_friction"),
    "The point robot": ("force", "wind_direction"),
    "A robot of your own": ("world",),
    "How it drives": ("seconds", "rate", "lockstep", "unfiltered", "controller"),
    "Model and settings": ("model", "effects", "settings", "margin", "perception", "diagnosis"),
    "Display, bus and output": ("headless", "fleet", "listen", "secure", "out", "as_json"),
}
"""Options by heading of ``--help``."""


@click.command(cls=GroupedCommand, groups=GROUPS)
@click.option(
    "--robot", shell_complete=complete_robots, help=f"kind of robot; default: {DEFAULT_ROBOT}, or that of --robot-file"
)
@click.option("--robot-file", type=PATH, metavar="FILE.py", help="a robot of your own; the file is executed")
@click.option("--name", default="r1", show_default=True, help="name of the robot on the bus")
@click.option(
    "--robots", type=int, default=1, show_default=True, help="number of robots, each in a scene of its own: r1, r2 ..."
)
@click.option("--load", type=SuggestingChoice(LOADS), help="what the car tows; default: none")
@click.option("--change", type=SuggestingChoice(CHANGES), help="fault that occurs during the drive")
@click.option("--change-after", type=float, default=30.0, show_default=True, help="robot time of --change in seconds")
@click.option(
    "--laser",
    is_flag=True,
    default=None,
    help="detect obstacles with a laser scanner and perception instead of reading them from the scene",
)
@click.option(
    "--people", type=int, metavar="COUNT", help="number of walking people around a robot with --laser; default: 0"
)
@click.option("--task", type=SuggestingChoice(TASKS), help="task of the pendulum; default: balance")
@click.option("--wind", type=float, metavar="SPEED", help="wind on the pendulum in m/s; default: 0")
@click.option(
    "--wind-direction", type=float, metavar="DEGREES", help="direction of the wind: 0 sideways, 90 upwards; default: 0"
)
@click.option("--force", type=float, metavar="NEWTON", help="force of the wind on the point robot; default: 0")
@click.option("--payload", type=float, metavar="KG", help="mass on the pendulum that no model knows; default: 0")
@click.option(
    "--dry-friction", type=float, metavar="TORQUE", help="friction in the pendulum's hinge in N m; default: 0"
)
@click.option(
    "--world", multiple=True, metavar="NAME=NUMBER", help="parameter of the simulation of your own robot; repeatable"
)
@click.option("--seconds", type=float, default=0.0, help="duration of the drive in robot time; 0: until Ctrl-C")
@click.option("--seed", type=int, default=0, show_default=True, help="seed of the scene: obstacles, start, goals")
@click.option("--rate", type=float, help="ticks per second; default: the robot's own (car 20, pendulum 100, point 50)")
@click.option(
    "--lockstep", is_flag=True, help="let the robot wait for each action; the drive is reproducible bit for bit"
)
@click.option(
    "--no-filter", "unfiltered", is_flag=True, help="pass the policy's nominal actions on unchecked, for comparison"
)
@click.option("--headless", is_flag=True, help="run without dashboard and workbench")
@click.option(
    "--diagnosis/--no-diagnosis",
    default=None,
    help="monitor the model and search for missing effects; default: yes, except with --lockstep --headless",
)
@click.option(
    "--model", shell_complete=complete_models, help="model file, or the name of a shipped one; default: the robot's"
)
@click.option("--effects", type=PATH, metavar="FILE.py", help="Python file with your own effects; it is executed")
@click.option("--settings", help="settings of the filter: a file or a name; default: the robot's")
@click.option("--margin", default="", help="margin file; default: the model's shipped one, if any")
@click.option(
    "--perception", default="", metavar="FILE.toml", help="file with settings, sources and zones of perception"
)
@click.option(
    "--controller",
    help="policy: goal_seeker, learned, planner, random ...; default: learned if the model's "
    "weights contain a policy, else the robot's own",
)
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus")
@click.option("--listen", default="", help="endpoint at which other processes can join, such as tcp/0.0.0.0:7447")
@click.option("--secure", is_flag=True, help="use mutual TLS through a router with access control")
@recordings_option
@as_json_option
def command(**options: Any) -> None:
    """Drive a simulated robot with all services.

    Starts robot, adaptation, policy, safety filter, recorder, diagnosis, dashboard and workbench, each as a process.
    Ends with Ctrl-C or after --seconds. Exit code 1 if the recording is incomplete.
    """
    from safedpa.bus.service.process import StopSignal
    from safedpa.dynamics import load_user_file_everywhere

    need("sim", what="the simulated robot", instead="run a robot of your own (docs/reference/bus.md)")
    if not options["headless"]:
        need("view", what="the dashboard", instead="leave it out with --headless")
    if options["effects"] is not None:
        load_user_file_everywhere(options["effects"])
    options = {**options, "robot": _robot_of(options)}
    if options["perception"] and not options["laser"]:
        raise InputError("--perception: got a file without --laser; add --laser, without which there is no perception")
    stop = StopSignal()
    with make_plan(options) as plan:
        stop.listen_to_signals()
        summary = run_plan(plan, stop, _display_of(plan, quiet=options["as_json"]))
    if options["as_json"]:
        click.echo(json.dumps(summary))
    else:
        _report(summary)
    if summary["recording_error"]:
        raise SafedpaError(f"the recording {summary['recording']} is incomplete: {summary['recording_error']}")


def default_options() -> dict[str, Any]:
    """Returns the default values of all options, for other commands that start a drive."""
    return dict(command.make_context("up", []).params)


def _robot_of(options: dict[str, Any]) -> str:
    """Returns the kind of robot: as given, from the robot file, or the default. Loads the file in all processes."""
    from safedpa.dynamics import load_user_file_everywhere
    from safedpa.systems.robots import robot_named, robots

    path = options["robot_file"]
    if path is None:
        return robot_named(options["robot"] or DEFAULT_ROBOT).name
    found = [name for name in load_user_file_everywhere(path) if name in robots()]
    if not found:
        raise InputError(f"--robot-file {path}: got no robot, wanted a class derived from AbstractRobot")
    if options["robot"] is not None and options["robot"] not in found:
        raise InputError(f"--robot: got '{options['robot']}', wanted one of {', '.join(found)}, which {path} declares")
    return str(options["robot"] or found[0])


@contextmanager
def make_plan(options: dict[str, Any], known: CertificateStore | None = None) -> Iterator[Plan]:
    """Yields the plan for the options; its endpoint and temporary certificates exist meanwhile.

    Raises InputError for invalid options. ``known``: the user's certificates, instead of the temporary ones of
    --secure.
    """
    with (
        _temporary_certificates(options) if known is None else nullcontext(known) as certificates,
        _endpoint(options, secured=certificates is not None) as endpoint,
    ):
        yield _plan({**options, "certificates": certificates, "endpoint": endpoint})


def _temporary_certificates(options: dict[str, Any]) -> AbstractContextManager[CertificateStore | None]:
    """Creates temporary certificates for --secure."""
    from safedpa_services.supervisor.certificate_store import ephemeral_certificates

    if not options["secure"]:
        return nullcontext()
    if options["robots"] > 1:
        raise InputError(
            "--robots: got more than 1 with --secure, whose certificates are for one robot; leave out one of them"
        )
    if options["listen"]:
        raise InputError(
            "--listen: got it with --secure, which is for this machine only; for other machines see "
            "docs/guides/security.md"
        )
    return ephemeral_certificates(options["fleet"], options["name"])


@contextmanager
def _endpoint(options: dict[str, Any], *, secured: bool) -> Iterator[str]:
    """Yields the endpoint of the loop: as given, else a socket that only this user can open."""
    from safedpa.bus.transport.ports import free_port
    from safedpa_services.supervisor.private_folder import private_folder

    if secured and options["listen"]:
        yield _local_endpoint(options["listen"])
        return
    if options["listen"] or secured:
        yield options["listen"] or f"tls/127.0.0.1:{free_port()}"
        return
    with private_folder() as folder:
        yield f"unixsock-stream/{folder}/bus"


def _local_endpoint(listen: str) -> str:
    """Returns the local endpoint of a router that listens at ``listen``, under a name of its certificate."""
    if not listen.startswith("tls/"):
        raise InputError(f"--listen: got '{listen}' with certificates, wanted tls/HOST:PORT")
    host, _, port = listen.removeprefix("tls/").rpartition(":")
    return f"tls/127.0.0.1:{port}" if host in ("0.0.0.0", "[::]") else listen


def _plan(options: dict[str, Any]) -> Plan:
    from safedpa.api.deployment import RATES
    from safedpa.bus import STATE, key_of
    from safedpa.dynamics import load_model
    from safedpa.perception import load_perception
    from safedpa.runtime.scene import check_senses
    from safedpa.safety.defaults import margin_for, settings_named
    from safedpa.systems.robots import robot_named
    from safedpa_services.supervisor.plan import Plan

    key_of(options["fleet"], options["name"], STATE)  # raises InputError for names that cannot be part of a key
    _check_numbers(options)
    robot, declared = options["robot"], robot_named(options["robot"])
    options = {**options, "model": options["model"] or str(declared.model)}
    model = load_model(options["model"])
    variant = declared.of_system(model.system)
    options = {
        **options,
        "settings": options["settings"] or variant.settings_name,
        "rate": variant.rate if options["rate"] is None else options["rate"],
    }
    if not RATES[0] <= options["rate"] <= RATES[1]:
        raise InputError(f"--rate: got {options['rate']}, wanted {RATES[0]:g} to {RATES[1]:g} ticks per second")
    _check_rate(model, options["rate"])
    _check_robot(model, robot, options["model"], options["settings"])
    margin_for(model, options["margin"])
    if options["laser"]:
        check_senses(model, settings_named(options["settings"]), "--laser")
    if options["perception"]:
        load_perception(Path(options["perception"]))
    return Plan(
        **{name: options[name] for name in _SAME_IN_PLAN},
        load=options["load"] or "none",
        filtered=not options["unfiltered"],
        dashboard=not options["headless"],
        sensor_inputs=bool(options["laser"]),
        diagnosis=_is_diagnosed(options),
        workbench_port=_workbench_port(options),
        surroundings=(*variant.stand_in_options, *_surroundings(options, variant)),
        change=options["change"] or "",
        controller=_controller(model, options["controller"]),
        listen=options["listen"] if options["certificates"] is not None else "",
        folder=Plan.new_folder(options["out"], options["name"]),
    )


def _check_numbers(options: dict[str, Any]) -> None:
    """Raises InputError for a number out of its range, naming the option."""
    for name, (low, high, wanted) in _RANGES.items():
        if options[name] is not None and not low <= options[name] <= high:
            raise InputError(f"{_flag(name)}: got {options[name]}, wanted {wanted}")


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _check_robot(model: PhysicsModel, robot: str, name: str, settings: str) -> None:
    """Raises InputError for the model or the settings of another robot, before any process starts."""
    from safedpa.runtime.scene import scene_of
    from safedpa.safety.defaults import settings_named
    from safedpa.systems.registry import why_not_driven

    refusal = why_not_driven(model.system, robot)
    if refusal:
        raise InputError(f"--model {name}: {refusal}")
    try:
        scene_of(model, settings_named(settings))
    except InputError as error:
        raise InputError(f"--settings {settings}: {error}") from error


def _surroundings(options: dict[str, Any], variant: Robot) -> tuple[str, ...]:
    """Returns the options that only this kind of robot has. Raises InputError for those of other kinds."""
    own = variant.options
    foreign = [name for name in _ROBOT_SPECIFIC if name not in own and options[name] not in (None, (), "none")]
    if options["change"] == "hitch" and "load" not in own:
        foreign = [*foreign, "change"]
    if foreign and variant.name == options["robot"] and variant.stand_in_options:
        raise InputError(
            f"{_flag(foreign[0])}: got '{options[foreign[0]]}' for a {variant.name} with "
            f"{', '.join(variant.system.action_names)}, which has none; leave it out, or choose another --model"
        )
    if foreign:
        raise InputError(
            f"{_flag(foreign[0])}: got one for a {options['robot']}, which has none; "
            f"leave it out, or choose a robot that has one with --robot: {_owners(foreign[0])}"
        )
    if options["people"] and not options["laser"]:
        raise InputError(
            f"--people: got {options['people']} without --laser; add --laser, without which the robot cannot see people"
        )
    given = [(name, options[name]) for name in own if name not in _FIELDS_OF_PLAN and options[name] is not None]
    each = [(name, value) for name, found in given for value in (found if isinstance(found, tuple) else (found,))]
    flags = [_flag(name) for name, value in each if value is True]
    return (*(f"{_flag(name)}={value}" for name, value in each if not isinstance(value, bool)), *flags)


def _owners(option: str) -> str:
    """Returns the names of the robots that have an option."""
    from safedpa.systems.robots import robots

    return ", ".join(name for name, robot in robots().items() if option in robot.options) or "one of your own"


def _is_diagnosed(options: dict[str, Any]) -> bool:
    """Returns whether the diagnosis runs: as given, by default except for reproducible runs without display."""
    if options["diagnosis"] is not None:
        return bool(options["diagnosis"])
    return not (options["lockstep"] and options["headless"])


def _workbench_port(options: dict[str, Any]) -> int:
    """Returns the workbench's port; 0 without display or diagnosis, or if its packages are not installed."""
    from safedpa.bus.transport.ports import free_port

    wanted = not options["headless"] and _is_diagnosed(options) and not missing("workbench")
    return free_port(range(8080, 8100)) if wanted else 0


def _controller(model: PhysicsModel, name: str | None) -> str:
    """Returns the controller's name; empty: the default. Raises InputError for one that does not fit the model."""
    from safedpa.policy.controller import controller_for

    controller_for(model, name)
    return name or ""


def _check_rate(model: PhysicsModel, rate: float) -> None:
    """Raises InputError if a learned model was trained for another rate: its networks predict one period."""
    from safedpa.dynamics import LearnedBase

    if isinstance(model.base, LearnedBase) and abs(rate * model.period - 1.0) > 0.01:
        raise InputError(
            f"--rate: got {rate:g} ticks per second, wanted those of the model's training, {1.0 / model.period:g}; "
            "leave out --rate"
        )


def supervise(
    plan: Plan, services: list[Child], robot: Child | None, stop: StopSignal, display: Display
) -> tuple[RunMonitor, list[Child], list[dict[str, Any]]]:
    """Runs services and robots until the end or ``stop``; returns what was heard, all processes, and the silences.

    ``display`` gets the first two. Raises SafedpaError if the robot failed.
    """
    from safedpa.bus import Bus, ZenohTransport
    from safedpa_services.supervisor.presence import RunPresence
    from safedpa_services.supervisor.run_monitor import RunMonitor
    from safedpa_services.supervisor.supervisor import Supervisor

    if plan.certificates is not None:
        services[0].start()  # the router, which the supervisor itself needs to join
    with Bus(ZenohTransport(plan.own_session()), plan.fleet) as bus:
        watch = RunMonitor(bus, plan.names[0])
        others = [(plan.robot_process(k + 1), RunMonitor(bus, name)) for k, name in enumerate(plan.names[1:])]
        children = [*([] if robot is None else [robot]), *(child for child, _ in others), *services]
        pairs = [*([] if robot is None else [(robot, watch)]), *others]
        driven = {monitor.robot: child for child, monitor in pairs}
        presence = RunPresence(bus, [watch, *(other for _, other in others)], services, driven)
        with display(watch, children) as on_turn:
            code = Supervisor(services, robot, watch, stop, on_turn, lambda: stop.hurried, others, presence).run()
    if code != 0 and robot is not None:
        raise SafedpaError(f"robot: {robot.last_text()}")
    return watch, children, presence.incidents()


def run_plan(plan: Plan, stop: StopSignal, display: Display) -> dict[str, Any]:
    """Drives until the end or ``stop`` and returns the summary. Raises SafedpaError if the robot failed."""
    from safedpa_services.supervisor.run_monitor import run_summary

    robot = plan.robot_process()
    watch, children, incidents = supervise(plan, plan.services(), robot, stop, display)
    if stop.hurried:
        click.echo(f"safedpa: ended immediately by the second signal; recording: {plan.recording}", err=True)
        raise click.exceptions.Exit(_EXIT_CODE_INTERRUPTED)
    if not robot.has_begun:
        raise SafedpaError("ended before the robot was started; nothing was driven")
    health = {name: message for name, (message, _) in watch.health.items()}
    others = plan.other_summaries
    summary = run_summary(plan.summary, watch.verdicts, children, health, plan.recording, watch.standstills, others)
    return {**summary, "incidents": incidents}


def _display_of(plan: Plan, *, quiet: bool) -> Display:
    from safedpa_services.supervisor.screen import screen

    where = plan.join_options
    hints = [f"recording {plan.recording}", f"others join with {where}", f"status: safedpa status --watch {where}"]
    if plan.diagnosis:
        hints.append(f"accept a proposed effect: safedpa accept {plan.name} EFFECT {where}")
    page = plan.workbench_address
    return lambda watch, children: screen(watch, children, hints, plan.folder, quiet=quiet, page=page)


def _report(summary: dict[str, Any]) -> None:
    verdicts = ", ".join(f"{count} {status}" for status, count in summary["verdicts"].items())
    latency = summary["latency_us"]
    click.echo(f"{summary['ticks']} ticks, {summary['goals_reached']} goals, {summary['collisions']} collisions")
    for name, other in summary.get("robots", {}).items():
        click.echo(f"{name}: {other['ticks']} ticks, {other['goals_reached']} goals, {other['collisions']} collisions")
    click.echo(
        f"verdicts: {verdicts}; the filter changed {summary['interventions']} of {summary['ticks']} nominal actions"
    )
    if summary["watchdog_ticks"]:
        share = 100.0 * summary["watchdog_ticks"] / max(summary["ticks"], 1)
        click.echo(
            f"in {summary['watchdog_ticks']} ticks ({share:.1f} %) no action arrived: the robot braked by itself"
        )
    for stand in summary["standstills"]:
        first = stand["reason"].partition(":")[0]
        others = [f"{kind} for {seconds:.0f} s" for kind, seconds in stand["reasons"].items() if kind != first]
        also = f" (also {', '.join(others)})" if others else ""
        print_plain(f"stationary for {stand['seconds']:.0f} s from {stand['from']:.1f} s on: {stand['reason']}{also}")
    for incident in summary["incidents"]:
        until = "" if incident["returned"] else " until the end"
        print_plain(f"{incident['name']}: silent for {incident['seconds']:.1f} s{until}")
    if latency["p50"] is not None:
        click.echo(f"sense to act: p50 {latency['p50']:.0f} us, p99 {latency['p99']:.0f} us")
    for service in summary["services"]:
        if service["restarts"]:
            cause = f", last because: {service['cause']}" if service["cause"] else ""
            print_plain(f"{service['name']}: restarted {service['restarts']} times{cause}")
    click.echo(f"recording: {summary['recording']}")
