"""A model is changed while one of those who use it, or who decides, cannot be reached: all stay or all go."""

from __future__ import annotations

import time
from typing import Literal

from safedpa.bus import ModelMessage, Request, TakeoverMessage
from safedpa_lab.faults.coordinator import EFFECT, FINDING
from safedpa_lab.faults.episode import Episode
from safedpa_lab.faults.fault import Fault, Work
from safedpa_lab.faults.proxy import PASS, STALLED
from safedpa_lab.faults.world import LOOP, Observer, Stamp, World

Moment = Literal["asked", "ready", "take"]
_MOMENTS: dict[Moment, str] = {
    "asked": "before a change is asked for",
    "ready": "as soon as it (or, of the diagnosis, one of them) is ready for the change",
    "take": "as soon as the change is decided",
}
_PARTITION_SECONDS = 4.0
_PATIENCE_SECONDS = 5.0
_ANSWER_SECONDS = 1.0


def partitioned_changes() -> list[Fault]:
    """Each service of the loop unreachable from three moments of a change on, and the diagnosis from two."""
    cases: list[tuple[str, Moment]] = [(name, moment) for name in LOOP for moment in _MOMENTS]
    cases += [("diagnosis", "ready"), ("diagnosis", "take")]
    return [
        Fault(
            f"change-{moment} {name}",
            f"{name} has no network for {_PARTITION_SECONDS:.0f} s, {_MOMENTS[moment]}",
            strike=_change(name, moment),
            repair=_reconnect(name),
            seconds=_PARTITION_SECONDS,
            check=_agreed_and_never_mixed,
            diagnosis="ready",
            small=(name, moment) == ("adaptation", "take"),
        )
        for name, moment in cases
    ]


def _change(name: str, moment: Moment) -> Work:
    """Asks for the change (or to take it back), and lets the network go at that moment."""

    def strike(world: World) -> None:
        if moment == "asked":
            world.bend(STALLED, name)
        before = len(world.observer.notice)
        world.until(lambda: _ask(world), _PATIENCE_SECONDS)
        if moment != "asked":
            world.until(lambda: _came(world.observer, before, name, moment), _PATIENCE_SECONDS)
            world.bend(STALLED, name)

    return strike


def _reconnect(name: str) -> Work:
    return lambda world: world.bend(PASS, name)


def _ask(world: World) -> bool:
    status = world.request(Request(do="status", who="faults"), _ANSWER_SECONDS)
    if status is None:
        return False
    do = "accept" if EFFECT in status.candidates else "roll_back"
    asked = Request(do=do, effect=EFFECT, model=status.fingerprint, finding=FINDING, who="faults")
    answer = world.request(asked, _ANSWER_SECONDS)
    return answer is not None and answer.ok


def _came(observer: Observer, before: int, name: str, moment: Moment) -> bool:
    notice = [message for _, message in observer.notice[before:]]
    if moment == "take":
        return any(isinstance(message, ModelMessage) and message.step == "take" for message in notice)
    return any(
        isinstance(message, TakeoverMessage) and message.state == "ready" and name in (message.service, "diagnosis")
        for message in notice
    )


def agreed(world: World) -> bool:
    """Whether nothing is under way, and all services tell the model that the diagnosis has in force."""
    status = world.request(Request(do="status", who="faults"), _ANSWER_SECONDS)
    if status is None or status.pending:
        return False
    newest = [world.observer.health.get(name) for name in LOOP]
    soon = time.monotonic() - 1.0
    return all(
        reported is not None and reported[1] > soon and reported[0].model == status.fingerprint for reported in newest
    )


def _agreed_and_never_mixed(world: World, _episode: Episode) -> str:
    if not world.until(lambda: agreed(world), 2.0 * _PATIENCE_SECONDS):
        models = {name: world.observer.health[name][0].model for name in LOOP}
        return f"they did not agree in the end: {models}"
    mixed = mixed_in(world.observer)
    return f"{len(mixed)} decisions with the latent of another model, the first at tick {mixed[0][1]}" if mixed else ""


def mixed_in(observer: Observer) -> list[Stamp]:
    """Periods in which the filter decided by another model than the latent's, and did not brake.

    The filter's model is the one that its verdict names. In real time its latent may be one tick old.
    """
    found = []
    for stamp, model in observer.latent_models.items():
        verdict = observer.verdicts.get(stamp)
        if verdict is None or verdict.status == "fallback" or not verdict.model:
            continue
        if verdict.model not in (model, observer.latent_models.get((stamp[0], stamp[1] - 1))):
            found.append(stamp)
    return found
