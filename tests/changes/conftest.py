"""Services without models, a coordinator and a network that loses, repeats and delays, all in one process."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

import pytest
from tests.messages import health_of, stamp, state_of

from safedpa.bus import (
    HEALTH,
    MODEL,
    TAKEOVER,
    VERDICT,
    AbstractNode,
    Answer,
    HealthMessage,
    Inputs,
    Message,
    ModelMessage,
    Outputs,
    Request,
    StateMessage,
    TakeoverMessage,
)
from safedpa.bus.service.model_versions import ModelVersions
from safedpa.dynamics import PhysicsModel, fingerprint, write_model
from safedpa.live.change import SERVICES, ModelChanges
from safedpa.live.versions import ModelVersion, OfferedEffect, VersionFolder

FIRST = ModelVersion("first", "document first")


def state_at(tick: int, epoch: int = 1) -> StateMessage:
    return state_of(0.0, 0.0, 0.0, 0.0, **stamp(tick, epoch=epoch), lockstep=True, footprint=(0.1, 0.4, 0.1))


def candidate(name: str) -> OfferedEffect:
    return OfferedEffect(effect=name, fingerprint=f"print {name}", document=f"document {name}", margin=f"margin {name}")


@dataclass
class Service:
    """What a node does with its versions at every tick; ``broken`` are documents that it cannot load."""

    name: str
    broken: frozenset[str] = frozenset()
    versions: ModelVersions[str] = field(init=False)

    def __post_init__(self) -> None:
        self.versions = ModelVersions(self.name, FIRST.document, FIRST.fingerprint, self._load)

    def _load(self, robot: str, offer: ModelMessage) -> str:
        if offer.document in self.broken:
            raise ValueError(f"{self.name} cannot load {offer.document}")
        return offer.document

    @property
    def model(self) -> str:
        return self.versions.fingerprint("r")


class Fleet:
    """One robot, three services, one coordinator; ``deliver`` says what becomes of each message."""

    def __init__(self, folder: Path | None = None, broken: dict[str, frozenset[str]] | None = None) -> None:
        self.folder = None if folder is None else VersionFolder(folder)
        self.broken = broken or {}
        self.services = {name: Service(name, self.broken.get(name, frozenset())) for name in SERVICES}
        self.changes: ModelChanges | None = ModelChanges(FIRST, self.folder)
        self.tick = self.epoch = 1
        self.deliver: Callable[[ModelMessage | TakeoverMessage], int] = lambda message: 1
        """How often a message arrives: 0 is lost."""
        self.spoken: list[ModelMessage] = []
        self.heard: list[TakeoverMessage] = []
        self.used: list[tuple[str, ...]] = []
        """Models of the services at every tick."""

    def ask(self, do: str, effect: str = "", **changed: object) -> Answer:
        assert self.changes is not None
        table = {"model": self.changes.fingerprint, "finding": 1, "who": "alice", **changed}
        return self.changes.answer(Request(do=do, effect=effect, **table))  # type: ignore[arg-type]

    def propose(self, *effects: str) -> None:
        assert self.changes is not None
        self.changes.propose(1, {effect: candidate(effect) for effect in effects})

    def turn(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.tick += 1
            state = state_at(self.tick, self.epoch)
            answers = [answer for service in self.services.values() if (answer := _tick(service, state))]
            self.used.append(tuple(service.model for service in self.services.values()))
            if self.changes is None:
                continue
            for answer in answers:
                self.heard.append(answer)
                for _ in range(self.deliver(answer)):
                    self.changes.hear(answer)
            for service in self.services.values():
                self.changes.hear(self.health_of(service))
            message = self.changes.step(state)
            if message is not None:
                self.spoken.append(message)
                for service in self.services.values():
                    for _ in range(self.deliver(message)):
                        service.versions.hear("r", message)

    def restart_service(self, name: str) -> None:
        """As after kill -9: a new process with the model of its options, which asks what is in force."""
        self.services[name] = Service(name, self.broken.get(name, frozenset()))
        status = None if self.changes is None else self.changes.answer(Request(do="status", who=name))
        self.services[name].versions.adopt_model("r", status)

    def restart_coordinator(self) -> None:
        self.changes = ModelChanges(FIRST, self.folder)

    def restart_robot(self) -> None:
        self.epoch, self.tick = self.epoch + 1, 0

    def state(self) -> StateMessage:
        self.tick += 1
        return state_at(self.tick, self.epoch)

    @property
    def models(self) -> set[str]:
        return {service.model for service in self.services.values()}

    def health_of(self, service: Service) -> HealthMessage:
        """Its heartbeat now."""
        return health_of(service.name, epoch=self.epoch, tick=self.tick, model=service.model)


def _tick(service: Service, state: StateMessage) -> TakeoverMessage | None:
    service.versions.begin("r", state)
    return service.versions.answer("r", state)


@pytest.fixture
def fleet_of() -> type[Fleet]:
    """``fleet_of(folder, broken)``: a fleet without models."""
    return Fleet


@pytest.fixture(scope="session")
def candidate_of() -> Callable[[str], OfferedEffect]:
    """``candidate_of(effect)``: one whose document is made already."""
    return candidate


@final
class ChangingNode(AbstractNode):
    """The part of a diagnosis that changes models, without the diagnosis: for drives in which a test is the person."""

    name = "diagnosis"
    inputs = (VERDICT,)
    outputs = (MODEL,)
    listens = (TAKEOVER, HEALTH)
    share = 0.9

    def __init__(self, model: PhysicsModel, folder: Path | None = None) -> None:
        first = ModelVersion(fingerprint(model), write_model(model))
        self.changes = ModelChanges(first, None if folder is None else VersionFolder(folder))
        self.spoken: list[ModelMessage] = []
        self.heard: list[TakeoverMessage] = []

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        message = self.changes.step(state)
        if message is None:
            return {}
        self.spoken.append(message)
        return {MODEL: message}

    def hear(self, robot: str, message: Message) -> None:
        assert isinstance(message, (TakeoverMessage, HealthMessage))
        if isinstance(message, TakeoverMessage):
            self.heard.append(message)
        self.changes.hear(message)


@pytest.fixture(scope="session")
def changing_node() -> type[ChangingNode]:
    """``changing_node(model, folder)``: offers models to real services."""
    return ChangingNode


@pytest.fixture(scope="session")
def driving_state() -> Callable[[int, int], StateMessage]:
    """``driving_state(tick, epoch)``: of a car in an empty field."""
    return state_at
