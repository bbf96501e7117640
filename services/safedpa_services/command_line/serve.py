"""``safedpa serve``: the services for a robot that is not simulated: one that speaks ROS 2, or the bus itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError
from safedpa.extras import missing, need
from safedpa_services.command_line.json_answer import answers_json, finish, report_progress
from safedpa_services.command_line.up import default_options, planned

if TYPE_CHECKING:
    from safedpa_services.ros_gateway.robot_file import ServedRobot
    from safedpa_services.supervisor.child import Child
    from safedpa_services.supervisor.plan import Plan
    from safedpa_services.supervisor.securing import CertificateStore

__all__ = ["command"]


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="ROBOT.toml")
@click.option("--robot-file", type=click.Path(path_type=Path), metavar="FILE.py", help="a robot of your own")
@click.option("--policy", "controller", metavar="NAME", help="run this policy here: goal_seeker, learned, planner ...")
@click.option("--perception", default="", metavar="FILE.toml", help="settings, sources and zones of perception")
@click.option("--headless", is_flag=True, help="no dashboard and no workbench")
@click.option("--diagnosis/--no-diagnosis", default=True, show_default=True, help="watch over the model")
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus")
@click.option("--listen", default="", help="where the robot joins, such as tcp/0.0.0.0:7447; a ROS robot needs none")
@click.option("--secure", is_flag=True, help="everything over mutual TLS, with certificates for this start alone")
@click.option(
    "--certificates",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="with those of 'safedpa certificates'",
)
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs"), show_default=True, help="for recordings")
@answers_json
def command(file: Path, **options: Any) -> None:
    """Serve the robot of ROBOT.toml: adaptation, safety filter, recorder, diagnosis, dashboard, workbench.

    Where the file says how it is reached by ROS 2, the gateway runs too, and its own policy requests by the topic of
    [nominal]; else the robot joins the bus by itself (docs/bus.md). Without [nominal] --policy names the policy, with
    [[scans]] perception runs too. With certificates a router lets everybody say and hear what is his. Until Ctrl-C.
    """
    from safedpa.bus.security.access_control import role_of_robot
    from safedpa.bus.service.process import StopSignal
    from safedpa.dynamics import load_own_everywhere
    from safedpa_services.ros_gateway.robot_file import RobotFile, load_served_robot

    if options["robot_file"] is not None:
        load_own_everywhere(options["robot_file"])
    asked = load_served_robot(file)
    speaks_ros = isinstance(asked, RobotFile)
    with_policy = isinstance(asked, RobotFile) and bool(asked.nominal.topic)
    if options["perception"] and not (isinstance(asked, RobotFile) and asked.scans):
        raise InputError(
            f"--perception: got a file, and {file} has no [[scans]]; leave it out, or name its scans there"
        )
    if speaks_ros:
        need("ros", what="a robot that speaks ROS 2")
    if with_policy and options["controller"]:
        raise InputError("--policy: got one for a robot whose own policy requests; leave one of the two out")
    if not with_policy and not options["controller"]:
        raise InputError(f"{file}: no policy; name one with --policy, or a topic in [nominal] of a ROS robot")
    if not options["headless"]:
        need("view", what="the dashboard", instead="leave it out with --headless")
    stop, own = StopSignal(), _own_certificates(options, speaks_ros=speaks_ros)
    with planned(_as_asked(asked, options), own) as made:
        stop.listen_to_signals()
        plan = replace(made, sensor_inputs=isinstance(asked, RobotFile) and bool(asked.scans))
        gateway = plan.gateway(file, with_policy=with_policy) if speaks_ros else None
        services = _services(plan, policy=not with_policy)
        if gateway is None:
            role = "" if plan.wallet is None else f" with the certificate of role {role_of_robot(plan.name)}"
            where = plan.door or plan.endpoint
            report_progress(
                f"serving robot '{plan.name}' at {where}, fleet {plan.fleet}; it joins there by itself{role}"
            )
        _serve(plan, gateway, services, stop)


def _own_certificates(options: dict[str, Any], *, speaks_ros: bool) -> CertificateStore | None:
    """The person's own, if he names them. Raises InputError for what does not go together."""
    from safedpa_services.supervisor.securing import CertificateStore

    if options["secure"] and options["certificates"] is not None:
        raise InputError("--secure: got it with --certificates, whose own are used; leave one of the two out")
    if options["secure"] and not speaks_ros:
        raise InputError(
            "--secure: its certificates go with this start, and a robot that joins by itself has none of them; make "
            "some with 'safedpa certificates DIR', and name them with --certificates DIR"
        )
    return None if options["certificates"] is None else CertificateStore(options["certificates"])


def _as_asked(asked: ServedRobot, options: dict[str, Any]) -> dict[str, Any]:
    """Options of a drive, as far as they hold without a simulator."""
    return {
        **default_options(),
        **options,
        "robot": asked.robot,
        "name": asked.name,
        "rate": asked.rate or None,
        "model": asked.model or None,
        "settings": asked.settings or None,
        "margin": asked.margin,
    }


def _services(plan: Plan, *, policy: bool) -> list[Child]:
    if missing("workbench"):
        plan = replace(plan, workbench_port=0)
    return [child for child in plan.services() if policy or child.name != "policy"]


def _serve(plan: Plan, gateway: Child | None, services: Sequence[Child], stop: Any) -> None:
    from safedpa.bus import Bus, ZenohTransport
    from safedpa.errors import SafedpaError
    from safedpa_services.supervisor.supervisor import Supervisor
    from safedpa_services.supervisor.watch import RunMonitor

    where = {"robot": plan.name, "fleet": plan.fleet, "endpoint": plan.door or plan.endpoint}
    report_progress(f"recording {plan.recording}", facts={**where, "recording": str(plan.recording)})
    if plan.workbench_address:
        report_progress(f"workbench {plan.workbench_address}", facts={"workbench": plan.workbench_address})
    if plan.wallet is not None:
        phrase = f"--connect {plan.endpoint} --fleet {plan.fleet} --certificates {plan.wallet.folder}"
        report_progress(f"how it is: safedpa status --watch {phrase}", facts={"certificates": str(plan.wallet.folder)})
    finish()  # where it is found is said at once
    if plan.wallet is not None:
        services[0].start()  # the router, through which the supervisor itself hears
    with Bus(ZenohTransport(plan.own_session()), plan.fleet) as bus:
        watch = RunMonitor(bus, plan.name)
        code = Supervisor(list(services), gateway, watch, stop, _DriveReporter(watch), lambda: stop.hurried).run()
    if code != 0 and gateway is not None:
        raise SafedpaError(f"robot: {gateway.last_text()}")


class _DriveReporter:
    """Says when the robot begins to drive, and when it brakes by itself: once each time."""

    def __init__(self, watch: Any) -> None:
        self._watch, self._message = watch, ""

    def __call__(self) -> None:
        """Looks whether something changed."""
        known = self._watch.health.get("robot")
        detail = known[0].detail if known is not None else ""
        state = self._watch.state
        now = "" if known is None and state is None else (detail[:40] or "drives")
        if now != self._message:
            self._message = now
            report_progress(f"robot {self._watch.robot}: {detail or 'the filter drives'}")
