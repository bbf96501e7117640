"""``safedpa up``: the whole closed loop of one robot, each part its own process, until Ctrl-C or --seconds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError
from safedpa.extras import missing, need
from safedpa.robot import DEFAULT_ROBOT
from safedpa_services.command_line.names import SuggestingChoice, complete_models, complete_robots
from safedpa_services.command_line.options import GroupedCommand
from safedpa_services.lines import print_plain

if TYPE_CHECKING:
    from safedpa.bus.service.process import StopSignal
    from safedpa.dynamics import PhysicsModel
    from safedpa.robot import AbstractRobot
    from safedpa_services.supervisor.child import Child
    from safedpa_services.supervisor.plan import Plan
    from safedpa_services.supervisor.securing import CertificateStore
    from safedpa_services.supervisor.watch import RunMonitor

    ShownBy = Callable[[RunMonitor, Sequence[Child], Child], AbstractContextManager[Callable[[], None]]]

__all__ = ["command", "default_options", "driven", "planned"]

LOADS = ("none", "box", "chair", "large_chair")
TASKS = ("balance", "swing")
_OF_SOME = (
    "load",
    "change",
    "laser",
    "people",
    "task",
    "wind",
    "wind_direction",
    "payload",
    "dry_friction",
    "force",
    "world",
)
"""Options that only some robots have, as these declare."""
_MOST_ROBOTS = 8
"""The dashboard has a tab for so many."""
_MOST_PEOPLE = 12
"""In the field of the simulated car."""
_MOST_FORCE = 0.0149
"""N; a stronger wind pushes harder than the point robot can."""
CHANGES = ("hitch", "headwind", "steering_offset")
_PLANNED = ("load", "change")
"""Of these, what the plan itself knows."""
_ENDED_AT_ONCE = 130
GROUPS = {
    "Which robot": ("robot", "robot_file", "name", "robots", "seed"),
    "The car": ("load", "change", "change_after", "laser", "people"),
    "The pendulum": ("task", "wind", "wind_direction", "payload", "dry_friction"),
    "The point robot": ("force", "wind_direction"),
    "A robot of your own": ("world",),
    "How it drives": ("seconds", "rate", "lockstep", "unfiltered", "controller"),
    "What it knows": ("model", "effects", "settings", "margin", "perception", "diagnosis"),
    "Where it is seen and heard": ("headless", "fleet", "listen", "secure", "out", "as_json"),
}
"""Options as ``--help`` groups them."""


@click.command(cls=GroupedCommand, groups=GROUPS)
@click.option(
    "--robot", shell_complete=complete_robots, help=f"kind of robot; default: {DEFAULT_ROBOT}, or that of --robot-file"
)
@click.option("--robot-file", type=click.Path(path_type=Path), metavar="FILE.py", help="a robot of your own")
@click.option("--name", default="r1", show_default=True, help="name of the robot on the bus")
@click.option(
    "--robots", type=int, default=1, show_default=True, help="how many, each in a scene of its own: r1, r2 ..."
)
@click.option("--load", type=SuggestingChoice(LOADS), help="what the car tows; default: none")
@click.option("--change", type=SuggestingChoice(CHANGES), help="what changes about the car while it drives")
@click.option("--change-after", type=float, default=30.0, show_default=True, help="seconds until then, by its clock")
@click.option(
    "--laser", is_flag=True, default=None, help="the car is told no obstacles: a laser and perception see them"
)
@click.option("--people", type=int, metavar="COUNT", help="who walk about where a car with --laser drives; default: 0")
@click.option("--task", type=SuggestingChoice(TASKS), help="what the pendulum has to do; default: balance")
@click.option("--wind", type=float, metavar="SPEED", help="m/s, on the pendulum; default: 0")
@click.option("--wind-direction", type=float, metavar="DEGREES", help="where it blows to: 0 aside, 90 up; default: 0")
@click.option("--force", type=float, metavar="NEWTON", help="of the wind on the point robot; default: 0")
@click.option("--payload", type=float, metavar="KG", help="hung on the pendulum, and no model is told; default: 0")
@click.option("--dry-friction", type=float, metavar="TORQUE", help="N m in the pendulum's hinge; default: 0")
@click.option(
    "--world", multiple=True, metavar="NAME=NUMBER", help="of the stand-in of a robot of your own; may be given again"
)
@click.option("--seconds", type=float, default=0.0, help="drive for so long by the robot's clock; 0: until Ctrl-C")
@click.option("--seed", type=int, default=0, show_default=True, help="scene: obstacles, start, goals")
@click.option("--rate", type=float, help="ticks per second; default: the robot's own (car 20, pendulum 100, point 50)")
@click.option("--lockstep", is_flag=True, help="the robot waits for each action: repeats bit for bit")
@click.option(
    "--no-filter", "unfiltered", is_flag=True, help="hand the policy's nominal actions on unchecked, to see why not"
)
@click.option("--headless", is_flag=True, help="no dashboard and no workbench")
@click.option(
    "--diagnosis/--no-diagnosis",
    default=None,
    help="watch over the model and search for what it lacks; default: yes, but not with --lockstep --headless",
)
@click.option(
    "--model", shell_complete=complete_models, help="model file, or the name of one that ships; default: the robot's"
)
@click.option("--effects", type=click.Path(path_type=Path), metavar="FILE.py", help="effects of your own in the model")
@click.option("--settings", help="settings of the filter: a file or a name; default: the robot's")
@click.option("--margin", default="", help="margin file; default: the shipped one of the model, if there is one")
@click.option("--perception", default="", metavar="FILE.toml", help="settings, sources and zones of perception")
@click.option(
    "--controller",
    help="who requests actions, such as goal_seeker, learned, planner, random; default: learned where the model's "
    "weights hold a policy, else the robot's own",
)
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus")
@click.option("--listen", default="", help="endpoint for others to join, such as tcp/0.0.0.0:7447")
@click.option("--secure", is_flag=True, help="everything over mutual TLS through a router with access control")
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs"), show_default=True, help="for recordings")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
def command(**options: Any) -> None:
    """Drive: robot, adaptation, policy, safety filter, recorder, diagnosis, dashboard, workbench: a process each."""
    from safedpa.bus.service.process import StopSignal
    from safedpa.dynamics import load_own_everywhere

    need("sim", what="the simulated robot", instead="run a robot of your own (docs/bus.md)")
    if not options["headless"]:
        need("view", what="the dashboard", instead="leave it out with --headless")
    if options["effects"] is not None:
        load_own_everywhere(options["effects"])
    options = {**options, "robot": _robot_of(options)}
    if options["perception"] and not options["laser"]:
        raise InputError("--perception: got a file without --laser; a robot that is told everything has no perception")
    stop = StopSignal()
    with planned(options) as plan:
        stop.listen_to_signals()
        summary = driven(plan, stop, _screen_of(plan, quiet=options["as_json"]))
    if options["as_json"]:
        click.echo(json.dumps(summary))
    else:
        _report(summary)


def default_options() -> dict[str, Any]:
    """Every option as it is where a person says nothing: what other commands that drive begin with."""
    return dict(command.make_context("up", []).params)


def _robot_of(options: dict[str, Any]) -> str:
    """The robot's name: as asked, that of the file, or the usual one. Loads the file, for every process."""
    from safedpa.dynamics import load_own_everywhere
    from safedpa.robot import robot_named, robots

    path = options["robot_file"]
    if path is None:
        return robot_named(options["robot"] or DEFAULT_ROBOT).name
    found = [name for name in load_own_everywhere(path) if name in robots()]
    if not found:
        raise InputError(f"--robot-file {path}: got no robot, wanted a class derived from AbstractRobot")
    if options["robot"] is not None and options["robot"] not in found:
        raise InputError(
            f"--robot: got '{options['robot']}', {path} declares {', '.join(found)}; leave one of them out"
        )
    return str(options["robot"] or found[0])


@contextmanager
def planned(options: dict[str, Any], known: CertificateStore | None = None) -> Iterator[Plan]:
    """The plan that the options ask for, with the place where its processes meet. Raises InputError for bad ones.

    ``known``: a person's own certificates, in place of those that --secure throws away.
    """
    with (
        _certificates(options) if known is None else nullcontext(known) as wallet,
        _meeting_place(options, secured=wallet is not None) as endpoint,
    ):
        yield _plan({**options, "wallet": wallet, "endpoint": endpoint})


def _certificates(options: dict[str, Any]) -> AbstractContextManager[CertificateStore | None]:
    """Throw-away certificates, if the person wants them."""
    from safedpa_services.supervisor.securing import ephemeral_certificates

    if not options["secure"]:
        return nullcontext()
    if options["robots"] > 1:
        raise InputError(
            "--robots: got more than 1 with --secure, whose certificates are for one; leave one of them out"
        )
    if options["listen"]:
        raise InputError("--listen: got it with --secure, which is for this machine alone; docs/security.md has more")
    return ephemeral_certificates(options["fleet"], options["name"])


@contextmanager
def _meeting_place(options: dict[str, Any], *, secured: bool) -> Iterator[str]:
    """Where the processes meet: without a word of the person at a socket that this user alone can reach."""
    from safedpa.bus.transport.ports import free_port
    from safedpa_services.supervisor.private_folder import private_folder

    if secured and options["listen"]:
        yield _from_inside(options["listen"])
        return
    if options["listen"] or secured:
        yield options["listen"] or f"tls/127.0.0.1:{free_port()}"
        return
    with private_folder() as folder:
        yield f"unixsock-stream/{folder}/bus"


def _from_inside(door: str) -> str:
    """Where this machine's processes find a router that listens at ``door``, under a name that its certificate has."""
    if not door.startswith("tls/"):
        raise InputError(f"--listen: got '{door}' with certificates, wanted tls/HOST:PORT")
    host, _, port = door.removeprefix("tls/").rpartition(":")
    return f"tls/127.0.0.1:{port}" if host in ("0.0.0.0", "[::]") else door


def _plan(options: dict[str, Any]) -> Plan:
    from safedpa.bus import STATE, key_of
    from safedpa.dynamics import load_model
    from safedpa.perception import load_perception
    from safedpa.robot import robot_named
    from safedpa.safety.defaults import margin_for
    from safedpa_services.driving import RATES
    from safedpa_services.supervisor.plan import Plan

    key_of(options["fleet"], options["name"], STATE)  # refuses names that the bus cannot carry
    _check_numbers(options)
    robot, declared = options["robot"], robot_named(options["robot"])
    options = {**options, "model": options["model"] or str(declared.model)}
    model = load_model(options["model"])
    driven = declared.of_system(model.system)
    options = {
        **options,
        "settings": options["settings"] or driven.settings_name,
        "rate": driven.rate if options["rate"] is None else options["rate"],
    }
    if not RATES[0] <= options["rate"] <= RATES[1]:
        raise InputError(f"--rate: got {options['rate']}, wanted {RATES[0]:g} to {RATES[1]:g} ticks per second")
    _check_rate(model, options["rate"])
    _check_robot(model, robot, options["model"], options["settings"])
    margin_for(model, options["margin"])
    if options["perception"]:
        load_perception(Path(options["perception"]))
    return Plan(
        robot=robot,
        name=options["name"],
        robots=options["robots"],
        load=options["load"] or "none",
        seconds=options["seconds"],
        seed=options["seed"],
        rate=options["rate"],
        lockstep=options["lockstep"],
        filtered=not options["unfiltered"],
        dashboard=not options["headless"],
        sensor_inputs=bool(options["laser"]),
        diagnosis=_is_diagnosed(options),
        workbench_port=_workbench_port(options),
        surroundings=(*driven.stand_in_options, *_surroundings(options, driven)),
        change=options["change"] or "",
        change_after=options["change_after"],
        model=options["model"],
        settings=options["settings"],
        margin=options["margin"],
        perception=options["perception"],
        controller=_controller(model, options["controller"]),
        fleet=options["fleet"],
        endpoint=options["endpoint"],
        wallet=options["wallet"],
        door=options["listen"] if options["wallet"] is not None else "",
        folder=Plan.new_folder(options["out"], options["name"]),
    )


def _check_numbers(options: dict[str, Any]) -> None:
    """Of any robot; raises InputError naming the option."""
    if not 0.0 <= options["seconds"] < 1e9:
        raise InputError(f"--seconds: got {options['seconds']}, wanted 0 (until Ctrl-C) or more")
    if not 0.0 <= options["change_after"] < 1e9:
        raise InputError(f"--change-after: got {options['change_after']}, wanted 0 seconds or more")
    if not 1 <= options["robots"] <= _MOST_ROBOTS:
        raise InputError(f"--robots: got {options['robots']}, wanted 1 to {_MOST_ROBOTS}")
    if options["seed"] < 0:
        raise InputError(f"--seed: got {options['seed']}, wanted 0 or more")


def _check_robot(model: PhysicsModel, robot: str, name: str, settings: str) -> None:
    """Refuses the model of another robot, and settings of another one, before any process starts."""
    from safedpa.runtime.scene import scene_of
    from safedpa.safety.defaults import settings_named
    from safedpa.systems.driven import why_not_driven

    refusal = why_not_driven(model.system, robot)
    if refusal:
        raise InputError(f"--model {name}: {refusal}")
    try:
        scene_of(model, settings_named(settings))
    except InputError as error:
        raise InputError(f"--settings {settings}: {error}") from error


def _surroundings(options: dict[str, Any], driven: AbstractRobot) -> tuple[str, ...]:
    """Options of the robot's process that only this kind has; refuses those of the others."""
    own = driven.options
    foreign = [name for name in _OF_SOME if name not in own and options[name] not in (None, (), "none")]
    if options["change"] == "hitch" and "load" not in own:
        foreign = [*foreign, "change"]
    if foreign and driven.name == options["robot"] and driven.stand_in_options:
        raise InputError(
            f"--{foreign[0].replace('_', '-')}: got '{options[foreign[0]]}' for a {driven.name} with "
            f"{', '.join(driven.system.action_names)}, whose stand-in has none; leave it out, or choose another --model"
        )
    if foreign:
        raise InputError(
            f"--{foreign[0].replace('_', '-')}: got one for a {options['robot']}, which has none; "
            f"leave it out, or choose a robot that has one with --robot: {_owners(foreign[0])}"
        )
    if options["people"] is not None and not 0 <= options["people"] <= _MOST_PEOPLE:
        raise InputError(f"--people: got {options['people']}, wanted 0 to {_MOST_PEOPLE}")
    if options["people"] and not options["laser"]:
        raise InputError(
            f"--people: got {options['people']} without --laser; only a car that sees them may meet people"
        )
    if options["wind"] is not None and not 0.0 <= options["wind"] <= 15.0:
        raise InputError(f"--wind: got {options['wind']}, wanted 0 to 15 m/s")
    if options["wind_direction"] is not None and not -360.0 <= options["wind_direction"] <= 360.0:
        raise InputError(f"--wind-direction: got {options['wind_direction']}, wanted -360 to 360 degrees")
    if options["force"] is not None and not 0.0 <= options["force"] <= _MOST_FORCE:
        raise InputError(f"--force: got {options['force']}, wanted 0 to {_MOST_FORCE:g} N")
    for name, most, unit in (("payload", 10.0, "kg"), ("dry_friction", 10.0, "N m")):
        if options[name] is not None and not 0.0 <= options[name] <= most:
            raise InputError(f"--{name.replace('_', '-')}: got {options[name]}, wanted 0 to {most:g} {unit}")
    given = [(name, options[name]) for name in own if name not in _PLANNED and options[name] is not None]
    each = [(name, value) for name, found in given for value in (found if isinstance(found, tuple) else (found,))]
    flags = [f"--{name.replace('_', '-')}" for name, value in each if value is True]
    return (*(f"--{name.replace('_', '-')}={value}" for name, value in each if not isinstance(value, bool)), *flags)


def _owners(option: str) -> str:
    """The robots that have an option of their own."""
    from safedpa.robot import robots

    return ", ".join(name for name, robot in robots().items() if option in robot.options) or "one of your own"


def _is_diagnosed(options: dict[str, Any]) -> bool:
    """As asked; without a word not where only a summary is wanted that repeats bit for bit."""
    if options["diagnosis"] is not None:
        return bool(options["diagnosis"])
    return not (options["lockstep"] and options["headless"])


def _workbench_port(options: dict[str, Any]) -> int:
    """Where the page is served; 0 where no one looks, nothing is diagnosed, or its framework is not installed."""
    from safedpa.bus.transport.ports import free_port

    wanted = not options["headless"] and _is_diagnosed(options) and not missing("workbench")
    return free_port(range(8080, 8100)) if wanted else 0


def _controller(model: PhysicsModel, name: str | None) -> str:
    """The name as given, empty without one; refuses one that the model cannot have, before any process starts."""
    from safedpa.policy.controller import controller_for

    controller_for(model, name)
    return name or ""


def _check_rate(model: PhysicsModel, rate: float) -> None:
    """Networks tell the change over one period, and no other."""
    from safedpa.dynamics import LearnedBase

    if isinstance(model.base, LearnedBase) and abs(rate * model.period - 1.0) > 0.01:
        raise InputError(
            f"--rate: got {rate:g} ticks per second, the model's networks were trained for {1.0 / model.period:g}; "
            "leave the rate out"
        )


def driven(plan: Plan, stop: StopSignal, shown_by: ShownBy) -> dict[str, Any]:
    """Drives until the end or ``stop`` and returns the summary. Raises SafedpaError where the robot failed."""
    from safedpa.bus import Bus, ZenohTransport
    from safedpa.errors import SafedpaError
    from safedpa_services.supervisor.supervisor import Supervisor
    from safedpa_services.supervisor.watch import RunMonitor, summary_of

    services, robot = plan.services(), plan.robot_process()
    if plan.wallet is not None:
        services[0].start()  # the router, through which the supervisor itself hears
    with Bus(ZenohTransport(plan.own_session()), plan.fleet) as bus:
        watch = RunMonitor(bus, plan.names[0])
        others = [(plan.robot_process(k + 1), RunMonitor(bus, name)) for k, name in enumerate(plan.names[1:])]
        shown = [*(child for child, _ in others), *services]
        with shown_by(watch, shown, robot) as on_turn:
            code = Supervisor(services, robot, watch, stop, on_turn, lambda: stop.hurried, others).run()
    if code != 0:
        raise SafedpaError(f"robot: {robot.last_text()}")
    if stop.hurried:
        click.echo(f"safedpa: ended at once at the second signal; what was recorded: {plan.recording}", err=True)
        raise click.exceptions.Exit(_ENDED_AT_ONCE)
    if not robot.begun:
        raise SafedpaError("ended before the robot was started; nothing was driven")
    health = {name: message for name, (message, _) in watch.health.items()}
    stationary_for, accounts = watch.standstills, plan.other_summaries
    return summary_of(plan.summary, watch.verdicts, [robot, *shown], health, plan.recording, stationary_for, accounts)


def _screen_of(plan: Plan, *, quiet: bool) -> ShownBy:
    from safedpa_services.supervisor.screen import screen

    where = f"--connect {plan.endpoint} --fleet {plan.fleet}"
    where += f" --certificates {plan.wallet.folder}" if plan.wallet is not None else ""
    hints = [f"recording {plan.recording}", f"others join with {where}"]
    hints.append(f"how it is: safedpa status --watch {where}")
    if plan.diagnosis:
        hints.append(f"add what the diagnosis proposes: safedpa accept {plan.name} EFFECT {where}")
    return lambda watch, services, robot: screen(
        watch, services, robot, hints, plan.folder, quiet=quiet, page=plan.workbench_address
    )


def _report(summary: dict[str, Any]) -> None:
    verdicts = ", ".join(f"{count} {status}" for status, count in summary["verdicts"].items())
    latency = summary["latency_us"]
    click.echo(f"{summary['ticks']} ticks, {summary['goals_reached']} goals, {summary['collisions']} collisions")
    for name, account in summary.get("robots", {}).items():
        click.echo(
            f"{name}: {account['ticks']} ticks, {account['goals_reached']} goals, {account['collisions']} collisions"
        )
    click.echo(
        f"verdicts: {verdicts}; the filter changed {summary['interventions']} of {summary['ticks']} nominal actions"
    )
    for stand in summary["standstills"]:
        print_plain(f"stood for {stand['seconds']:.0f} s from {stand['from']:.1f} s on: {stand['reason']}")
    if latency["p50"] is not None:
        click.echo(f"sense to act: p50 {latency['p50']:.0f} us, p99 {latency['p99']:.0f} us")
    restarts = {service["name"]: service["restarts"] for service in summary["services"] if service["restarts"]}
    if restarts:
        click.echo("restarted: " + ", ".join(f"{name} {count} times" for name, count in restarts.items()))
    if summary["recording_error"]:
        print_plain(f"recording broke off: {summary['recording_error']}", err=True)
    click.echo(f"recording: {summary['recording']}")
