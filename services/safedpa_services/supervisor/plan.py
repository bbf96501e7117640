"""The plan of a run: which processes it has, with which options, and where their files go."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from safedpa.bus import ZenohSettings
from safedpa.bus.security.access_control import ROUTER, role_of_robot
from safedpa.errors import InputError
from safedpa_services.supervisor.certificate_store import OPERATOR, CertificateStore
from safedpa_services.supervisor.child import Child

_POLICY = "policy"
"""Role whose certificate the gateway uses to publish the nominal actions of the robot's own policy."""
_TOKEN_VARIABLE = "SAFEDPA_PAGE_TOKEN"


@dataclass(frozen=True)
class Plan:
    """The control loop of one robot, or of several of a kind, as given by the command line."""

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
    """Name of the policy's controller; empty: the default for the model."""
    fleet: str
    endpoint: str
    """Endpoint at which the supervisor listens; every process connects to it and discovers the others there."""
    folder: Path
    diagnosis: bool = False
    """Whether a diagnosis runs alongside the loop."""
    awaits_diagnosis: bool = False
    """Whether the robots begin to drive only once the diagnosis is ready, and thereby sees all of the drive."""
    workbench_port: int = 0
    """Port of the workbench's page; 0: no workbench."""
    page_token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    """Grants access to the workbench's page, including requests to the diagnosis."""
    surroundings: tuple[str, ...] = ()
    """Options of the robot's process that only some robots have."""
    change: str = ""
    """Fault that occurs during the drive; empty: none."""
    change_after: float = 0.0
    """Earliest robot time of the fault [s]."""
    change_on_word: bool = False
    """Whether the fault also waits for ``Child.signal``."""

    sensor_inputs: bool = False
    """Whether the robot has sensors and the loop therefore has perception."""
    perception: str = ""
    """File with the settings, sources and zones of perception; empty: the defaults."""
    robots: int = 1
    """Number of robots, each in a scene of its own, all served by the same services."""
    certificates: CertificateStore | None = None
    """With certificates, all messages go through a router over mutual TLS; None: plain text between the processes."""
    listen: str = ""
    """Endpoint at which the router listens, if it differs from ``endpoint``."""

    @property
    def recording(self) -> Path:
        """The MCAP file of the run."""
        return self.folder / "recording.mcap"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the robots on the bus, numbered from ``name``: r1, r2, r3."""
        if self.robots == 1:
            return (self.name,)
        stem = self.name.rstrip("0123456789")
        first = int(self.name[len(stem) :] or 1)
        return tuple(f"{stem}{first + index}" for index in range(self.robots))

    @property
    def summary(self) -> Path:
        """JSON file with the summary that the first robot writes at its end."""
        return self._summary(0)

    def _summary(self, index: int) -> Path:
        return self.folder / (f"robot-{self.names[index]}.json" if index else "robot.json")

    @property
    def other_summaries(self) -> dict[str, Path]:
        """Summary files of the other robots, by name."""
        return {name: self._summary(index) for index, name in enumerate(self.names) if index}

    @property
    def _scheduling(self) -> list[str]:
        """In real time the control loop gets real-time priority; processes that only observe do not."""
        return [] if self.lockstep else ["--realtime"]

    def services(self) -> list[Child]:
        """Returns all processes except the robots."""
        model = ("--model", self.model)
        controller = ("--controller", self.controller) if self.controller else ()
        unfiltered = () if self.filtered else ("--off",)
        margin = ("--settings", self.settings, *(("--margin", self.margin) if self.margin else ()))
        orders = ("--orders", str(self.folder / "orders.json"))
        child, scheduling = self._child, self._scheduling
        file = ("--perception", self.perception) if self.perception else ()
        senses = (*file, "--orders", str(self.folder / "senses.json"))
        versions, saved = self.folder / "models", self.folder / "dashboard.rrd"
        children = [
            child("adaptation", *model, *scheduling),
            *([child("perception", *senses, *scheduling)] if self.sensor_inputs else []),
            child("policy", *model, *controller, *scheduling),
            child("safety_filter", *model, *margin, *unfiltered, *orders, *scheduling),
            child("recorder", "--out", str(self.recording)),
        ]
        if self.diagnosis:
            diagnosis = child("diagnosis", *model, *margin, "--versions", str(versions), essential=False)
            diagnosis.awaited = self.awaits_diagnosis
            children.append(diagnosis)
        if self.dashboard:
            children.append(child("dashboard", *model, "--settings", self.settings, "--save", str(saved)))
        if self.workbench_port:
            children.append(self._workbench())
        return children if self.certificates is None else [self._router(self.certificates), *children]

    def _router(self, certificates: CertificateStore) -> Child:
        """Returns the router, which starts first and ends last."""
        bus = ("--fleet", self.fleet, "--listen", self.listen or self.endpoint)
        identity, credentials = certificates.options_of(ROUTER)
        options = (*bus, *identity, "--robot", self.name, *self._scheduling)
        return Child("router", "safedpa_services.router", options, self.folder / "router.log", credentials=credentials)

    def _workbench(self) -> Child:
        page = ("--model", self.model, "--out", str(self.folder / "workbench"), "--port", str(self.workbench_port))
        where = ("--folder", str(self.folder))
        child = self._child("workbench", *page, *where, essential=False, heartbeat=False)
        child.environment = {_TOKEN_VARIABLE: self.page_token}
        return child

    @property
    def workbench_address(self) -> str:
        """URL of the live page with its token; empty without a workbench."""
        port = self.workbench_port
        return f"http://127.0.0.1:{port}/live?token={self.page_token}" if port else ""

    def with_page_alone(self) -> Plan:
        """Returns this plan without the dashboard; the live page stays."""
        return replace(self, dashboard=False)

    @property
    def join_options(self) -> str:
        """Options with which other commands join the bus."""
        certificates = "" if self.certificates is None else f" --certificates {self.certificates.folder}"
        return f"--connect {self.endpoint} --fleet {self.fleet}{certificates}"

    def own_session(self) -> ZenohSettings:
        """Returns how the supervisor joins: in plain text it listens for the others, with TLS it is an operator."""
        if self.certificates is None:
            return ZenohSettings(listen=(self.endpoint,))
        return ZenohSettings("client", (), (self.endpoint,), self.certificates.identity(OPERATOR))

    def gateway(self, file: Path, *, with_policy: bool) -> Child:
        """Returns the gateway, the robot's process for a ROS 2 robot.

        :param with_policy: whether the gateway forwards the nominal actions of the robot's own policy
        """
        child = self._child("robot", str(file), module="safedpa_services.ros_gateway")
        if self.certificates is not None and self.certificates.credentials and with_policy:
            child.extra_credentials = {"--policy-card": self.certificates.credentials[_POLICY]}
        return child

    def robot_process(self, index: int = 0) -> Child:
        """Returns the process of a simulated robot; the seed of its scene is ``seed + index``."""
        options = ["--robot", self.robot, "--name", self.names[index], "--load", self.load]
        options += ["--seed", str(self.seed + index), "--rate", repr(self.rate), "--seconds", repr(self.seconds)]
        options += ["--summary", str(self._summary(index))]
        options += self.surroundings
        options += ["--change", self.change, "--change-after", repr(self.change_after)] if self.change else []
        options += ["--change-on-word"] if self.change_on_word else []
        options += ["--lockstep"] if self.lockstep else self._scheduling
        name = f"robot {self.names[index]}" if index else "robot"
        child = self._child(name, *options, heartbeat=not index, module="safedpa_sim.robots")
        child.waits = True
        return child

    def _child(
        self, name: str, *arguments: str, essential: bool = True, heartbeat: bool = True, module: str = ""
    ) -> Child:
        """Returns a process, by default the service of its name."""
        bus = ["--fleet", self.fleet, "--connect", self.endpoint]
        credentials = None
        if self.certificates is not None:
            role = role_of_robot(self.name) if name == "robot" else name
            identity, credentials = self.certificates.options_of(role)
            bus += identity
        log = self.folder / f"{name.replace(' ', '-')}.log"
        module = module or f"safedpa_services.{name}"
        return Child(name, module, (*arguments, *bus), log, essential, heartbeat, credentials=credentials)

    @staticmethod
    def new_folder(parent: Path, name: str) -> Path:
        """Creates a folder ``<time>-<name>`` for one run, for this user alone; raises InputError if that fails."""
        stamp = time.strftime("%Y%m%d-%H%M%S")
        for attempt in range(100):
            folder = parent / (f"{stamp}-{name}" + (f"-{attempt}" if attempt else ""))
            try:
                folder.mkdir(0o700, parents=True)
            except FileExistsError:
                continue
            except OSError as error:
                raise InputError(f"{folder}: cannot be created ({error.strerror}); choose another --out") from error
            return folder
        raise InputError(f"{parent}: got a hundred runs of this second; choose another --out")
