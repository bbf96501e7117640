"""The documents of ``safedpa replay --json``, key by key, against the recording."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import VERDICT, VerdictMessage, decode
from safedpa.records.readers.mcap import read_payloads
from safedpa_services.command_line.group import safedpa

BOX = str(Path(__file__).parent / "golden" / "car_box.mcap")


def document_of(capsys: pytest.CaptureFixture[str], *options: str) -> Any:
    assert safedpa.run(["replay", BOX, "--json", *options]) == 0  # type: ignore[attr-defined]
    return json.loads(capsys.readouterr().out)


def test_the_document_of_a_replay_has_all_that_the_lines_say(capsys: pytest.CaptureFixture[str]) -> None:
    document = document_of(capsys, "--from", "1", "--to", "2.999")
    sent = {"adaptation": {"latent": 40}, "policy": {"nominal": 40}, "safety_filter": {"verdict": 40, "action": 40}}
    assert document.pop("services") == [
        {"service": name, "compared": counts, "identical": counts, "differing": 0, "rounded": 0, "spans": [], "lost": 0}
        for name, counts in sent.items()
    ]
    recorded = [decode(VerdictMessage, payload) for _, _, topic, payload in read_payloads(BOX) if topic is VERDICT]
    assert document.pop("verdicts") == Counter(verdict.status for verdict in recorded)
    assert document.pop("least_h_now") == min(verdict.h_now for verdict in recorded)
    assert document == {
        "format": 1, "robot": "r1", "files": [BOX], "states": 120, "seconds": [0.0, 5.95], "agrees": True,
        "exact": True, "assumed": [], "findings": [], "not_recorded": [], "differences": [],
        "braked_by_watchdog": 0,
    }  # fmt: skip


def test_the_document_of_a_what_if_has_recorded_and_hypothetical_decisions(capsys: pytest.CaptureFixture[str]):
    document = document_of(capsys, "--eta", "0.1")
    recorded = [decode(VerdictMessage, payload) for _, _, topic, payload in read_payloads(BOX) if topic is VERDICT]
    assert (document["changed"], document["states"]) == ("eta 0.1", "recorded (open loop)")
    summary, differing = document["summary"], document["differing"]
    assert summary["status_then"] == Counter(verdict.status for verdict in recorded)
    assert sum(summary["status_now"].values()) == len(recorded)
    assert summary["smallest_h_then"] == min(verdict.h_next for verdict in recorded)
    assert summary["differing"] == len(differing)
    by_tick = {verdict.tick: verdict for verdict in recorded}
    for decision in differing:
        then, now, verdict = decision["then"], decision["now"], by_tick[decision["tick"]]
        assert (decision["epoch"], decision["robot_time"]) == (verdict.epoch, verdict.robot_time)
        assert then == {
            "status": verdict.status, "action": list(verdict.action), "h_now": verdict.h_now,
            "h_next": verdict.h_next, "margin": verdict.margin, "slack": verdict.slack,
        }  # fmt: skip
        assert then.keys() == now.keys()
        assert (now["status"], now["action"]) != (then["status"], then["action"])
