"""Where the router of a secured loop listens, and as whom the supervisor joins: by plans of which nothing starts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.services.test_plan import named, planned

from safedpa.bus.security.certificates import Card
from safedpa_services.supervisor.plan import Plan

INSIDE, DOOR = "tls/127.0.0.1:7450", "tls/0.0.0.0:7447"


def card_of(role: str) -> Card:
    return Card(role, b"", b"", b"")


@pytest.fixture
def wallet() -> Any:
    """Shows for each role its name, and hands out its card."""
    return SimpleNamespace(shown=lambda role: (("--role", role), card_of(role)), identity=card_of, cards={})


def after(words: tuple[str, ...], option: str) -> str:
    return words[words.index(option) + 1]


@pytest.mark.parametrize("door", ["", DOOR])
def test_the_router_listens_at_the_door_where_there_is_one_and_the_others_connect_on_this_machine(
    door: str, wallet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = replace(planned(monkeypatch, tmp_path), wallet=wallet, endpoint=INSIDE, door=door)
    children = named(plan)
    assert next(iter(children)) == "router"
    assert after(children["router"].arguments, "--listen") == (door or INSIDE)
    for name, child in children.items():
        if name != "router":
            assert after(child.arguments, "--connect") == INSIDE
            assert (after(child.arguments, "--role"), child.card) == (name, card_of(name))
    assert plan.robot_process().card == card_of(f"robot.{plan.name}")


def test_the_supervisor_is_an_operator_of_a_secured_loop_and_in_plain_text_what_the_others_connect_to(
    wallet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan: Plan = replace(planned(monkeypatch, tmp_path), endpoint="tcp/127.0.0.1:7450")
    plain = plan.own_session()
    assert (plain.mode, plain.listen, plain.connect, plain.certificates) == ("peer", (plan.endpoint,), (), None)
    secured = replace(plan, endpoint=INSIDE, wallet=wallet).own_session()
    assert (secured.mode, secured.listen, secured.connect) == ("client", (), (INSIDE,))
    assert secured.certificates == card_of("operator")
    assert "router" not in named(plan)
