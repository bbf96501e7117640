"""Which processes a loop consists of, with which options, and where their files go."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from safedpa.bus import ZenohSettings
from safedpa.bus.security.access_control import ROUTER, role_of_robot
from safedpa.errors import InputError
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.securing import OPERATOR, CertificateStore

__all__ = ["Plan"]

_POLICY = "policy"
"""Whose certificate a robot's own policy shows for its nominal action."""
_TOKEN_VARIABLE = "SAFEDPA_PAGE_TOKEN"


@dataclass(frozen=True)
class Plan:
    """One robot's loop, as the person asked for it."""

    robot: str
    name: str
    load: str
    seconds: float
    seed: int
    rate: float
    lockstep: bool
    filtered: bool
    dashboard: bool
    model: str
    settings: str
    margin: str
    controller: str
    """Name of the policy's controller; empty: the one that the model allows."""
    fleet: str
    endpoint: str
    """Where the supervisor's own session listens; every process connects to it and learns of the others there."""
    folder: Path
    diagnosis: bool = False
    """Whether a diagnosis runs alongside the loop."""
    workbench_port: int = 0
    """Where the workbench serves its page; 0: no workbench."""
    page_token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    """Who has it may look at the workbench and ask the diagnosis there."""
    surroundings: tuple[str, ...] = ()
    """Further options of the robot's process."""
    change: str = ""
    """What changes about the robot while it drives; empty: nothing."""
    change_after: float = 0.0
    """s until then, by the robot's clock."""

    sensor_inputs: bool = False
    """Whether the robot has sensors of its own, and perception runs alongside the loop."""
    perception: str = ""
    """Its settings, sources and zones: a file; empty: the defaults."""
    robots: int = 1
    """How many drive side by side, each in a scene of its own, all served by the same services."""
    wallet: CertificateStore | None = None
    """A certificate and key for every role: everything goes through a router over mutual TLS; None: plain text."""
    door: str = ""
    """Where that router listens, if not at the endpoint to which the processes of this machine connect."""

    @property
    def recording(self) -> Path:
        """The MCAP file of the run."""
        return self.folder / "recording.mcap"

    @property
    def names(self) -> tuple[str, ...]:
        """Of the robots on the bus: the name counted on, as r1, r2, r3."""
        if self.robots == 1:
            return (self.name,)
        stem = self.name.rstrip("0123456789")
        first = int(self.name[len(stem) :] or 1)
        return tuple(f"{stem}{first + index}" for index in range(self.robots))

    @property
    def summary(self) -> Path:
        """What the first robot says of itself at its end, as JSON."""
        return self._summary(0)

    def _summary(self, index: int) -> Path:
        return self.folder / (f"robot-{self.names[index]}.json" if index else "robot.json")

    @property
    def other_summaries(self) -> dict[str, Path]:
        """The same of the other robots, by name."""
        return {name: self._summary(index) for index, name in enumerate(self.names) if index}

    @property
    def _scheduling(self) -> list[str]:
        """In real time the loop comes before everything else on the machine; what only looks on does not."""
        return [] if self.lockstep else ["--realtime"]

    def services(self) -> list[Child]:
        """Every process but the robot."""
        model = ("--model", self.model)
        controller = ("--controller", self.controller) if self.controller else ()
        unfiltered = () if self.filtered else ("--off",)
        margin = ("--settings", self.settings, *(("--margin", self.margin) if self.margin else ()))
        children = [
            self._child("adaptation", "safedpa_services.adaptation", *model, *self._scheduling),
            self._child("policy", "safedpa_services.policy", *model, *controller, *self._scheduling),
            self._child(
                "safety_filter",
                "safedpa_services.safety_filter",
                *(*model, *margin, *unfiltered, "--orders", str(self.folder / "orders.json"), *self._scheduling),
            ),
            self._child("recorder", "safedpa_services.recorder", "--out", str(self.recording)),
        ]
        if self.sensor_inputs:
            file = ("--perception", self.perception) if self.perception else ()
            retained = ("--orders", str(self.folder / "senses.json"))
            children.insert(
                1, self._child("perception", "safedpa_services.perception", *file, *retained, *self._scheduling)
            )
        if self.diagnosis:
            retained = ("--versions", str(self.folder / "models"))
            children.append(
                self._child("diagnosis", "safedpa_services.diagnosis", *model, *margin, *retained, essential=False)
            )
        if self.dashboard:
            saved = ("--save", str(self.folder / "dashboard.rrd"))
            children.append(
                self._child("dashboard", "safedpa_services.dashboard", *model, "--settings", self.settings, *saved)
            )
        if self.workbench_port:
            children.append(self._workbench())
        return children if self.wallet is None else [self._router(self.wallet), *children]

    def _router(self, wallet: CertificateStore) -> Child:
        """Starts first and ends last."""
        bus = ("--fleet", self.fleet, "--listen", self.door or self.endpoint)
        shown, card = wallet.shown(ROUTER)
        options = (*bus, *shown, "--robot", self.name, *self._scheduling)
        return Child("router", "safedpa_services.router", options, self.folder / "router.log", card=card)

    def _workbench(self) -> Child:
        page = ("--model", self.model, "--out", str(self.folder / "workbench"), "--port", str(self.workbench_port))
        where = ("--folder", str(self.folder))
        child = self._child("workbench", "safedpa_services.workbench", *page, *where, essential=False, heartbeat=False)
        child.environment = {_TOKEN_VARIABLE: self.page_token}
        return child

    @property
    def workbench_address(self) -> str:
        """The live page, with the token that opens it; empty without one."""
        port = self.workbench_port
        return f"http://127.0.0.1:{port}/live?token={self.page_token}" if port else ""

    def with_page_alone(self) -> Plan:
        """The same without the dashboard; the live page stays."""
        return replace(self, dashboard=False)

    def own_session(self) -> ZenohSettings:
        """How the supervisor itself joins: in plain text it is what the others connect to, else an operator."""
        if self.wallet is None:
            return ZenohSettings(listen=(self.endpoint,))
        return ZenohSettings("client", (), (self.endpoint,), self.wallet.identity(OPERATOR))

    def gateway(self, file: Path, *, with_policy: bool) -> Child:
        """The robot's process where it speaks ROS 2: the gateway. ``with_policy``: its own policy's topic is subscribed to there."""
        child = self._child("robot", "safedpa_services.ros_gateway", str(file))
        if self.wallet is not None and self.wallet.cards and with_policy:
            child.further = {"--policy-card": self.wallet.cards[_POLICY]}
        return child

    def robot_process(self, index: int = 0) -> Child:
        """The robot, or another one next to it, whose scene has the next seed."""
        options = ["--robot", self.robot, "--name", self.names[index], "--load", self.load]
        options += ["--seed", str(self.seed + index), "--rate", repr(self.rate), "--seconds", repr(self.seconds)]
        options += ["--summary", str(self._summary(index))]
        options += self.surroundings
        options += ["--change", self.change, "--change-after", repr(self.change_after)] if self.change else []
        options += ["--lockstep"] if self.lockstep else self._scheduling
        name = f"robot {self.names[index]}" if index else "robot"
        child = self._child(name, "safedpa_sim.robots", *options, heartbeat=not index)
        child.waits = True
        return child

    def _child(self, name: str, module: str, *arguments: str, essential: bool = True, heartbeat: bool = True) -> Child:
        bus = ["--fleet", self.fleet, "--connect", self.endpoint]
        card = None
        if self.wallet is not None:
            shown, card = self.wallet.shown(role_of_robot(self.name) if name == "robot" else name)
            bus += shown
        log = self.folder / f"{name.replace(' ', '-')}.log"
        return Child(name, module, (*arguments, *bus), log, essential, heartbeat, card=card)

    @staticmethod
    def new_folder(parent: Path, name: str) -> Path:
        """A folder for one run, ``<time>-<name>`` under ``parent``; raises InputError when it cannot be made."""
        stamp = time.strftime("%Y%m%d-%H%M%S")
        for attempt in range(100):
            folder = parent / (f"{stamp}-{name}" + (f"-{attempt}" if attempt else ""))
            try:
                folder.mkdir(parents=True)
            except FileExistsError:
                continue
            except OSError as error:
                raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another --out") from error
            return folder
        raise InputError(f"{parent}: holds a hundred runs of this second; choose another --out")
