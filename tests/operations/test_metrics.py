"""Metrics: conventional names, values as in the messages, rules and dashboards that refer to existing metrics."""

import json
import os
import re
import shutil
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml

from safedpa.bus import RosterEntry
from safedpa.errors import InputError
from safedpa_services.metrics.exporter import FAMILIES, Exporter, FleetCollector

pytest.importorskip("prometheus_client", reason="prometheus_client is not installed; install 'safedpa[metrics]'")

RULES = Path(__file__).resolve().parents[2] / "deploy" / "prometheus"
SCENARIO = """
rule_files: [ALERTS]
evaluation_interval: 5s
tests:
  - interval: 5s
    input_series:
      - {series: 'safedpa_robot_up{robot="r1"}', values: '1x24 0x12'}
      - {series: 'safedpa_ticks_total{robot="r1"}', values: '0+100x36'}
      - {series: 'safedpa_late_ticks_total{robot="r1"}', values: '0x12 0+5x24'}
      - {series: 'safedpa_verdicts_total{robot="r1",status="fallback"}', values: '7x36'}
      - {series: 'safedpa_service_processes{service="recorder"}', values: '1x36'}
      - {series: 'safedpa_unreadable_messages_total', values: '0x36'}
      - {series: 'safedpa_missing{kind="robot",name="r1"}', values: '0x24 1x12'}
    alert_rule_test:
      - {eval_time: 1m, alertname: SafedpaRobotSilent}
      - {eval_time: 1m, alertname: SafedpaLateTicks}
      - {eval_time: 2m30s, alertname: SafedpaFallback}
      - {eval_time: 2m30s, alertname: SafedpaServiceGone}
      - {eval_time: 2m30s, alertname: SafedpaExporterGone}
      - eval_time: 2m30s
        alertname: SafedpaRobotSilent
        exp_alerts:
          - exp_labels: {severity: page, robot: r1}
            exp_annotations: {summary: "Robot r1 says nothing; its watchdog brakes it, if it lives."}
      - {eval_time: 2m, alertname: SafedpaMissing}
      - eval_time: 2m30s
        alertname: SafedpaMissing
        exp_alerts:
          - exp_labels: {severity: page, kind: robot, name: r1}
            exp_annotations:
              summary: "robot r1 should be there and is silent; 'safedpa dismiss' if it was taken away."
      - eval_time: 2m30s
        alertname: SafedpaLateTicks
        exp_alerts:
          - exp_labels: {severity: page, robot: r1}
            exp_annotations: {summary: "5% of the ticks of r1 come without an action in time."}
"""
NAME = re.compile(r"\bsafedpa_[a-z0-9_]+")


def exposed(collector: FleetCollector) -> str:
    from prometheus_client import CollectorRegistry, generate_latest

    registry = CollectorRegistry()
    registry.register(collector)
    return generate_latest(registry).decode()


def value(text: str, sample: str) -> float:
    found = [line.rsplit(" ", 1)[1] for line in text.splitlines() if line.startswith(sample + " ")]
    assert len(found) == 1, f"{sample}: {found}"
    return float(found[0])


@pytest.fixture
def talked(fleet: Any) -> Any:
    """A fleet of two, one of which falls back, with every kind of process."""
    fleet.drive(2, 2.0, r2={"verdict": {"status": "fallback"}})
    fleet.finding("r1", "raised", "speed: less than predicted")
    fleet.beat("router", refused=3)
    fleet.list_members(RosterEntry(kind="robot", name="r1"), RosterEntry(kind="service", name="policy"))
    return fleet


def test_counts_are_those_of_the_messages(talked: Any) -> None:
    collector = FleetCollector(talked.overview)
    collector.listen(0.0)
    text = exposed(collector)
    assert value(text, 'safedpa_ticks_total{robot="r1"}') == 40
    assert value(text, 'safedpa_verdicts_total{robot="r1",status="passed"}') == 40
    assert value(text, 'safedpa_verdicts_total{robot="r2",status="fallback"}') == 40
    assert value(text, 'safedpa_late_ticks_total{robot="r2"}') == 0
    assert value(text, 'safedpa_robot_healthy{robot="r1"}') == 1
    assert value(text, 'safedpa_robot_healthy{robot="r2"}') == 0
    assert value(text, 'safedpa_sense_to_act_seconds_count{robot="r1"}') == 16
    assert value(text, 'safedpa_sense_to_act_seconds_bucket{le="0.003",robot="r1"}') == 0
    assert value(text, 'safedpa_sense_to_act_seconds_bucket{le="0.005",robot="r1"}') == 16
    assert value(text, 'safedpa_sense_to_act_seconds_sum{robot="r1"}') == pytest.approx(8 * (0.0031 + 0.0042))
    steps = value(text, 'safedpa_step_seconds_count{service="policy"}')
    assert steps > 0
    assert value(text, 'safedpa_step_seconds_sum{service="policy"}') == pytest.approx(steps * 150e-6)
    assert value(text, 'safedpa_diagnosis_stage{robot="r1",stage="raised"}') == 1
    assert value(text, 'safedpa_model_error{robot="r1"}') == 0.3
    assert value(text, 'safedpa_refused_messages_total{pid="1006",service="router"}') == 3
    assert value(text, 'safedpa_service_processes{service="safety_filter"}') == 1
    talked.now += 5.0
    text = exposed(collector)
    assert value(text, 'safedpa_service_processes{service="safety_filter"}') == 0
    assert value(text, 'safedpa_robot_up{robot="r1"}') == 0
    assert value(text, 'safedpa_message_age_seconds{robot="r1",topic="state"}') > 4.9


@pytest.mark.parametrize(
    ("seconds", "reported", "works"), [(1.4, 1, 1), (1.6, 1, 0), (29.0, 1, 0), (31.0, 0, 0), (250.0, 0, 0)]
)
def test_a_process_is_down_after_a_second_and_a_half_and_exported_for_half_a_minute(
    fleet: Any, seconds: float, reported: int, works: int
):
    """Each start is a process of its own: a service that restarts for a week must not leave a row for each."""
    fleet.beat("router", pid=77, refused=3)
    fleet.tick("r1", state={}, verdict={})
    collector = FleetCollector(fleet.overview)
    collector.listen(0.0)
    fleet.now += seconds
    text = exposed(collector)
    assert text.count('safedpa_service_info{pid="77"') == reported
    assert text.count('safedpa_heartbeat_age_seconds{pid="77"') == reported
    assert value(text, 'safedpa_service_processes{service="router"}') == works
    assert value(text, 'safedpa_robot_up{robot="r1"}') == works


def test_scraping_twice_counts_nothing_twice(talked: Any) -> None:
    collector = FleetCollector(talked.overview)
    collector.listen(0.0)
    first = exposed(collector)
    collector.listen(0.0)
    assert exposed(collector) == first


def test_every_described_family_is_exported_and_no_other(talked: Any) -> None:
    collector = FleetCollector(talked.overview)
    collector.listen(0.0)
    text = exposed(collector)
    samples = {re.split(r"[{ ]", line)[0] for line in text.splitlines() if not line.startswith("#")}
    bases = {re.sub(r"_(bucket|count|sum|created)$", "", name) if "seconds_" in name else name for name in samples}
    assert bases == set(FAMILIES)


@pytest.mark.parametrize("name", FAMILIES)
def test_names_follow_the_conventions(name: str) -> None:
    family = FAMILIES[name]
    assert re.fullmatch(r"safedpa(_[a-z0-9]+)+", name)
    assert name.endswith("_total") is (family.kind == "counter")
    assert family.kind != "histogram" or name.rsplit("_", maxsplit=1)[-1] == "seconds"
    assert family.meaning.endswith(".")
    assert not re.search(r"milli|micro|percent|_ms|_us", name), "base units alone"


def asked_of_prometheus() -> list[tuple[str, str]]:
    rules = yaml.safe_load((RULES / "alerts.yml").read_text(encoding="utf-8"))
    asked = [(rule["alert"], rule["expr"]) for group in rules["groups"] for rule in group["rules"]]
    board = json.loads((RULES / "dashboard.json").read_text(encoding="utf-8"))
    return asked + [(panel["title"], target["expr"]) for panel in board["panels"] for target in panel["targets"]]


@pytest.mark.parametrize(("title", "expression"), asked_of_prometheus())
def test_rules_and_dashboard_ask_for_metrics_that_there_are(title: str, expression: str) -> None:
    names = NAME.findall(expression)
    assert names, title
    for name in names:
        base = name.removesuffix("_bucket")
        assert base in FAMILIES, f"{title}: {name}"
        assert (base != name) is (FAMILIES[base].kind == "histogram"), f"{title}: {name}"
    for label in re.findall(r"[{,]\s*(\w+)=~?\"", expression):
        assert any(label in FAMILIES[name.removesuffix("_bucket")].labels for name in names), f"{title}: {label}"


def promtool(*arguments: str, text: str = "") -> str:
    program = shutil.which("promtool")
    if program is None:
        pytest.skip("promtool is not installed; Debian's package 'prometheus' has it")
    done = subprocess.run(
        [program, *arguments], input=text, capture_output=True, text=True, cwd=RULES, check=False, timeout=60
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_promtool_accepts_rules_and_configuration() -> None:
    assert "SUCCESS" in promtool("check", "rules", "alerts.yml")
    assert "SUCCESS" in promtool("check", "config", "prometheus.yml")


def test_alerts_are_raised_when_they_should_and_not_before(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yml"
    scenario.write_text(SCENARIO.replace("ALERTS", str(RULES / "alerts.yml")), encoding="utf-8")
    assert "SUCCESS" in promtool("test", "rules", str(scenario))


def test_promtool_finds_nothing_to_criticise_in_the_page(talked: Any) -> None:
    collector = FleetCollector(talked.overview)
    collector.listen(0.0)
    assert promtool("check", "metrics", text=exposed(collector)) == ""


def test_the_page_is_served_and_the_port_is_free_afterwards(talked: Any, free_port: int) -> None:
    for _ in range(2):
        exporter, served = Exporter(talked.overview, "127.0.0.1", free_port), []

        def stopped(served: list[str] = served) -> bool:
            if talked.overview.services.keys() & {("metrics", os.getpid())}:
                with urllib.request.urlopen(f"http://127.0.0.1:{free_port}/metrics", timeout=60) as page:
                    served.append(page.read().decode())
            return bool(served)

        exporter.run(stopped)
        assert value(served[0], 'safedpa_ticks_total{robot="r1"}') == 40


def test_a_port_in_use_is_refused(talked: Any) -> None:
    exporter = Exporter(talked.overview, "127.0.0.1", 0)
    with pytest.raises(InputError, match="cannot listen there"):
        Exporter(talked.overview, "127.0.0.1", exporter.port)
    exporter.run(lambda: True)
