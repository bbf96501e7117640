"""``safedpa serve``: runs the services for a real robot, which uses ROS 2 or joins the bus itself."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError
from safedpa.extras import need
from safedpa_services.command_line.json_answer import answers_json, finish, report_progress
from safedpa_services.command_line.options import PATH, recordings_option
from safedpa_services.command_line.up import default_options, make_plan, supervise

if TYPE_CHECKING:
    from safedpa_services.ros_gateway.robot_file import ServedRobot
    from safedpa_services.ros_gateway.sensor_tables import SourceTopic
    from safedpa_services.supervisor.certificate_store import CertificateStore
    from safedpa_services.supervisor.child import Child
    from safedpa_services.supervisor.plan import Plan
    from safedpa_services.supervisor.run_monitor import RunMonitor


@click.command()
@click.argument("file", type=PATH, metavar="ROBOT.toml")
@click.option("--robot-file", type=PATH, metavar="FILE.py", help="a robot of your own; the file is executed")
@click.option("--policy", "controller", metavar="NAME", help="run this policy: goal_seeker, learned, planner ...")
@click.option(
    "--perception", default="", metavar="FILE.toml", help="file with settings, sources and zones of perception"
)
@click.option("--headless", is_flag=True, help="no dashboard and no workbench")
@click.option(
    "--diagnosis/--no-diagnosis",
    default=True,
    show_default=True,
    help="monitor the model and search for missing effects",
)
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus")
@click.option(
    "--listen", default="", help="endpoint at which the robot joins, such as tcp/0.0.0.0:7447; not needed for ROS"
)
@click.option("--secure", is_flag=True, help="use mutual TLS with temporary certificates")
@click.option(
    "--certificates", type=PATH, metavar="DIR", help="use mutual TLS with the certificates of 'safedpa certificates'"
)
@recordings_option
@answers_json
def command(file: Path, **options: Any) -> None:
    """Run the services for the real robot of ROBOT.toml.

    These are adaptation, safety filter, recorder, diagnosis, dashboard and workbench.

    If the file describes a ROS 2 robot, the gateway runs too; otherwise the robot joins the bus itself
    (docs/reference/bus.md). The nominal actions come from the robot's own policy, on the topic of [nominal], or from
    the policy named with --policy. With [[scans]] or [[sources]], perception runs too. With certificates, all messages
    go through a router with access control. Ends with Ctrl-C.
    """
    from safedpa.bus.security.access_control import role_of_robot
    from safedpa.bus.service.process import StopSignal
    from safedpa.dynamics import load_model, load_user_file_everywhere
    from safedpa.runtime.scene import check_senses
    from safedpa.safety.defaults import settings_named
    from safedpa_services.ros_gateway.robot_file import RobotFile, load_served_robot

    if options["robot_file"] is not None:
        load_user_file_everywhere(options["robot_file"])
    robot_file = load_served_robot(file)
    uses_ros = isinstance(robot_file, RobotFile)
    with_policy = isinstance(robot_file, RobotFile) and bool(robot_file.nominal.topic)
    sensors = robot_file.sensors if isinstance(robot_file, RobotFile) else ()
    if options["perception"] and not sensors:
        raise InputError(
            f"--perception: got a file, but {file} has no [[scans]] or [[sources]]; leave it out, or add sensors there"
        )
    if uses_ros:
        need("ros", what="a robot that uses ROS 2")
    if with_policy and options["controller"]:
        raise InputError(
            "--policy: got one, and the robot's file names a topic of its own policy ([nominal]); leave out one of them"
        )
    if not with_policy and not options["controller"]:
        raise InputError(
            f"{file}: got no policy; use --policy, or for a ROS robot name the topic of its own policy in [nominal]"
        )
    if not options["headless"]:
        need("view", what="the dashboard", instead="leave it out with --headless")
    stop, own = StopSignal(), _own_certificates(options, uses_ros=uses_ros)
    with make_plan(_drive_options(robot_file, options), own) as base_plan:
        stop.listen_to_signals()
        if sensors:
            check_senses(load_model(base_plan.model), settings_named(base_plan.settings), str(file))
        plan = replace(base_plan, sensor_inputs=bool(sensors))
        if sensors and not plan.perception:
            plan = replace(plan, perception=_perception_file(sensors, plan.folder))
        gateway = plan.gateway(file, with_policy=with_policy) if uses_ros else None
        services = [child for child in plan.services() if child.name != "policy" or not with_policy]
        if gateway is None:
            role = "" if plan.certificates is None else f" with the certificate of role {role_of_robot(plan.name)}"
            where = plan.listen or plan.endpoint
            report_progress(f"serving robot '{plan.name}' at {where}, fleet {plan.fleet}; waiting for it to join{role}")
        _report_start(plan)
        supervise(plan, services, gateway, stop, partial(_reported, plan))


def _perception_file(sensors: Sequence[SourceTopic], folder: Path) -> str:
    """Writes the settings that perception needs for these sensors, and returns the name of the file."""
    from safedpa_services.ros_gateway.sensor_tables import perception_text

    path = folder / "perception.toml"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(perception_text(sensors), encoding="utf-8")
    return str(path)


def _own_certificates(options: dict[str, Any], *, uses_ros: bool) -> CertificateStore | None:
    """Returns the user's certificates, if the options name a folder. Raises InputError for conflicting options."""
    from safedpa_services.supervisor.certificate_store import CertificateStore

    if options["secure"] and options["certificates"] is not None:
        raise InputError("--secure: got it together with --certificates; leave out one of them")
    if options["secure"] and not uses_ros:
        raise InputError(
            "--secure: got it for a robot that joins the bus itself and cannot have the temporary certificates; create "
            "certificates with 'safedpa certificates DIR', and use --certificates DIR"
        )
    return None if options["certificates"] is None else CertificateStore(options["certificates"])


def _drive_options(robot_file: ServedRobot, options: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of ``safedpa up`` for a robot that is not simulated."""
    return {
        **default_options(),
        **options,
        "robot": robot_file.robot,
        "name": robot_file.name,
        "rate": robot_file.rate or None,
        "model": robot_file.model or None,
        "settings": robot_file.settings or None,
        "margin": robot_file.margin,
    }


def _report_start(plan: Plan) -> None:
    from safedpa_services.web.browser import shown_address

    where = {"robot": plan.name, "fleet": plan.fleet, "endpoint": plan.listen or plan.endpoint}
    report_progress(f"recording {plan.recording}", facts={**where, "recording": str(plan.recording)})
    if plan.workbench_address:
        shown = shown_address(plan.workbench_address, plan.folder, is_terminal=sys.stdout.isatty())
        report_progress(f"workbench {shown}", facts={"workbench": shown})
    if plan.certificates is not None:
        facts = {"certificates": str(plan.certificates.folder)}
        report_progress(f"status: safedpa status --watch {plan.join_options}", facts=facts)
    finish()  # print the JSON document now: the command runs until Ctrl-C


def _reported(plan: Plan, watch: RunMonitor, children: Sequence[Child]) -> AbstractContextManager[Callable[[], None]]:
    """Returns the display of a served run: a line for each change, restart and silence."""
    from safedpa_services.supervisor.log_warnings import LogWarnings

    drive = _drive_reporter(watch)
    warnings = LogWarnings(children, plan.folder, report_progress, watch.notices)

    def turn() -> None:
        drive()
        warnings.look()

    return nullcontext(turn)


def _drive_reporter(watch: RunMonitor) -> Callable[[], None]:
    """Returns a function that reports when the robot begins to drive and when the gateway brakes it, once a change."""
    last = ""

    def report() -> None:
        nonlocal last
        known = watch.health.get("robot")
        detail = known[0].detail if known is not None else ""
        kind = re.sub(r"[\d.]+", "", detail)  # the same reason with another age is reported once
        now = "" if known is None and watch.state is None else (kind or "drives")
        if now != last:
            last = now
            report_progress(f"robot {watch.robot}: {detail or 'the filter drives'}")

    return report
