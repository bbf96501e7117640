"""Which faults there are, what was heard and what was recorded, from messages that are written down by hand."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.faults.test_fault_batches import DECLARE, FRAME, PUSH, batch
from tests.faults.test_fault_episode import PERIOD, evidence, lived, trace, verdict

from safedpa.bus import ModelMessage, TakeoverMessage
from safedpa_lab.faults import model_changes, recorded
from safedpa_lab.faults.batches import carries_data
from safedpa_lab.faults.episode import Episode, Evidence, recovery_of, stale_in
from safedpa_lab.faults.network import cut
from safedpa_lab.faults.processes import hung
from safedpa_lab.faults.world import ROBOT, World


@pytest.mark.parametrize("size", [1, 127, 128, 300])
@pytest.mark.parametrize("kind", [PUSH, DECLARE])
def test_data_is_recognised_behind_an_extension_of_many_bytes(size: int, kind: int) -> None:
    """The length is told in sevens of bits, the lowest first: 300 are 0b0000010 and 0b0101100."""
    length = [size] if size < 128 else [0x80 | size % 128, size // 128]
    body = (FRAME | 0x80, 0x03, 0x45, *length, *[DECLARE if kind == PUSH else PUSH] * size, kind, 0x00)
    assert carries_data(batch(*body)) is (kind == PUSH)


@pytest.mark.parametrize(
    ("sent", "stale"),
    [
        ({(1.0, 0.1)}, 0),
        ({(1.0, 0.1), (0.5, 0.2)}, 0),  # two filters, one of which was obeyed
        ({(0.5, 0.2), (1.0, -0.1), (1.0, 0.1)}, 0),
        ({(0.5, 0.1)}, 1),
        ({(1.0, 0.2), (0.5, 0.1)}, 1),  # one number of each
        (set(), 0),
        (None, 0),
    ],
)
def test_an_action_was_sent_where_any_that_was_sent_for_its_state_is_it(
    sent: set[tuple[float, ...]] | None, stale: int
) -> None:
    """(1.0, 0.1) was applied; where nothing was heard nothing is known."""
    periods = [lived(7)]
    actions = {} if sent is None else {(5, 7): sent}
    found = stale_in(periods, Evidence(periods, {}, actions, PERIOD))
    assert len(found) == stale
    assert all("tick 7: the filter never sent" in one for one in found)


def test_links_are_cut_and_half_open() -> None:
    faults = {fault.name: fault for fault in cut()}
    assert list(faults) == [
        "cut policy", "cut safety_filter", "cut robot", "half-open adaptation", "half-open safety_filter",
        "half-open robot",
    ]  # fmt: skip
    assert "hears, and is not heard" in faults["half-open robot"].sentence
    assert len({fault.sentence for fault in faults.values()}) == 6


def test_every_loop_hangs_and_three_interpreters_are_gripped() -> None:
    names = [fault.name for fault in hung()]
    assert names[-3:] == ["grip policy", "grip safety_filter", "grip recorder"]
    services = {name.removeprefix("hang ") for name in names[:-3]}
    assert services >= {"adaptation", "policy", "safety_filter", "recorder", "diagnosis"}
    assert len(names) == len(set(names))


def model(step: str) -> ModelMessage:
    return ModelMessage(
        epoch=1, tick=1, robot_time=0.0, publish_time=0.0, step=step, change=1, fingerprint="f", replaces="e"
    )


def takeover(service: str, state: str) -> TakeoverMessage:
    return TakeoverMessage(
        epoch=1, tick=1, robot_time=0.0, publish_time=0.0, service=service, change=1, fingerprint="f", state=state
    )


OTHERS = [model("offer"), takeover("adaptation", "ready"), takeover("policy", "taken"), model("drop")]


@pytest.mark.parametrize(
    ("moment", "name", "said", "came"),
    [
        ("take", "policy", [*OTHERS, model("take")], True),
        ("take", "policy", [model("take"), *OTHERS], True),
        ("take", "policy", OTHERS, False),
        ("take", "policy", [], False),
        ("ready", "policy", [*OTHERS, takeover("policy", "ready")], True),
        ("ready", "policy", [takeover("policy", "ready"), *OTHERS], True),
        ("ready", "policy", OTHERS, False),
        ("ready", "policy", [], False),
        ("ready", "diagnosis", OTHERS, True),  # whoever is ready
        ("ready", "diagnosis", [model("offer"), takeover("policy", "refused")], False),
    ],
)
def test_a_moment_of_a_change_has_come_where_any_message_says_so(
    moment: Any, name: str, said: list[ModelMessage | TakeoverMessage], came: bool
) -> None:
    observer: Any = SimpleNamespace(said=[(float(number), message) for number, message in enumerate(said)])
    assert model_changes._came(observer, 0, name, moment) is came
    before = [model("take"), takeover(name, "ready")]
    observer.said = [(0.0, message) for message in (*before, *said)]
    assert model_changes._came(observer, len(before), name, moment) is came, "what was said before does not count"


def test_every_message_is_counted_and_those_of_one_robot_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two files; other robots and other topics count among the messages alone."""

    def message(tick: int, epoch: int = 1) -> Any:
        return SimpleNamespace(epoch=epoch, tick=tick)

    files = {
        "a": [("f/v/r1/state/x", message(1)), ("f/v/r1/verdict/x", message(1)), ("f/v/r2/state/x", message(7))],
        "b": [("f/v/r1/state/x", message(2)), ("f/v/r1/wish/x", message(2)), ("f/v/r1/state/x", message(1, 2)),
              ("f/v/r1/verdict/x", message(1))],
    }  # fmt: skip
    names = {recorded.STATE.name: "state", recorded.VERDICT.name: "verdict"}
    assert names == {name: name for name in names}
    monkeypatch.setattr(
        recorded, "read_messages", lambda file, _: iter([(key, 0, one) for key, one in files[file.name]])
    )
    found = recorded.read_recorded([Path("a"), Path("b")], "r1")
    assert found.messages == 7
    assert found.states == {(1, 1), (1, 2), (2, 1)}
    assert found.verdicts == {(1, 1)}
    assert found.lost([(1, 1), (1, 3), (1, 3), (2, 2)], [(1, 1), (1, 2)]) == (2, 1)
    assert recorded.read_recorded([], "r1").messages == 0


def test_a_robot_of_the_campaign_tells_what_it_did(tmp_path: Path) -> None:
    """Into files on its own disk, of which every judgement is made."""
    world: Any = SimpleNamespace(
        settings=SimpleNamespace(load="box", seed=7), trace=tmp_path / "trace.jsonl", folder=tmp_path,
        proxy=SimpleNamespace(endpoint=lambda name: f"tcp/{name}"), _member=lambda *given: given,
    )  # fmt: skip
    name, module, *options = World._robot(world)  # type: ignore[misc]
    assert (name, module) == ("robot", "safedpa_sim.robots")
    told = dict(pairwise(options))
    assert (told["--trace"], told["--summary"]) == (str(tmp_path / "trace.jsonl"), str(tmp_path / "robot.json"))
    assert (told["--name"], told["--load"], told["--seed"], told["--connect"]) == (ROBOT, "box", "7", "tcp/robot")
    assert "--realtime" in options


@pytest.mark.parametrize("late", [0.0, 0.5])
def test_an_action_that_began_to_act_late_is_stale_whoever_sent_it(late: float) -> None:
    periods = [replace(lived(3), applied_at=PERIOD * 3.9 + late)]
    found = stale_in(periods, Evidence(periods, {}, {(5, 3): {(1.0, 0.1)}}, PERIOD))
    assert len(found) == (late > 0.0)


@pytest.mark.parametrize(("status", "driven"), [("passed", True), ("corrected", True), ("fallback", False)])
def test_a_period_is_driven_where_the_filter_had_all_that_it_needs(status: str, driven: bool) -> None:
    told = {(5, 2): replace(verdict(2), status=status)}
    assert Evidence([], told, {}, PERIOD).is_driven(lived(2)) is driven
    assert not Evidence([], told, {}, PERIOD).is_driven(lived(2, "watchdog"))
    assert Evidence([], {}, {}, PERIOD).is_driven(lived(2)), "whose verdict was not heard"


def test_an_outage_that_was_over_before_the_fault_was_mended_needs_no_recovery() -> None:
    """From tick 6 to the action of tick 9, which acts a tenth of a period before."""
    episode = Episode(struck=6 * PERIOD, mended=10 * PERIOD, ended=40 * PERIOD)
    assert recovery_of(evidence(trace("d" * 6 + "www" + "d" * 31)), episode) == 0.0
    assert recovery_of(evidence(trace("d" * 6 + "wwww" + "d" * 30)), episode) == pytest.approx(0.9 * PERIOD)
