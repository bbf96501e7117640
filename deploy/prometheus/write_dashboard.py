"""Writes ``dashboard.json`` next to it, for Grafana: ``python deploy/prometheus/write_dashboard.py``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

PANELS = (
    ("Robots that are heard", "sum(safedpa_robot_up)", "short"),
    ("Robots in trouble", "sum(1 - safedpa_robot_healthy)", "short"),
    ("Processes by service", "safedpa_service_processes", "short"),
    ("Verdicts per second, by status", "sum by (status) (rate(safedpa_verdicts_total[1m]))", "short"),
    (
        "Share of late ticks",
        "rate(safedpa_late_ticks_total[1m]) / rate(safedpa_ticks_total[1m])",
        "percentunit",
    ),
    (
        "Sense to act, 99 %",
        "histogram_quantile(0.99, sum by (robot, le) (rate(safedpa_sense_to_act_seconds_bucket[1m])))",
        "s",
    ),
    (
        "Time of a step, 99 %",
        "histogram_quantile(0.99, sum by (service, le) (rate(safedpa_step_seconds_bucket[5m])))",
        "s",
    ),
    ("Barrier value h", "safedpa_barrier_value", "short"),
    ("Coverage of the margin", "safedpa_margin_coverage", "percentunit"),
    ("Error of the model over its band", "safedpa_model_error / (safedpa_model_error_band > 0)", "short"),
    ("Refused messages per second", "sum by (service) (rate(safedpa_refused_messages_total[1m]))", "short"),
    ("Messages recorded per second", 'rate(safedpa_steps_total{service="recorder"}[1m])', "short"),
)
"""Title, what is asked of Prometheus, unit as Grafana names it."""

_WIDE, _HIGH, _IN_A_ROW = 8, 7, 3


def dashboard() -> dict[str, Any]:
    """The document that Grafana imports."""
    return {
        "uid": "safedpa",
        "title": "safedpa: a fleet",
        "schemaVersion": 39,
        "refresh": "5s",
        "time": {"from": "now-15m", "to": "now"},
        "templating": {"list": [{"name": "source", "type": "datasource", "query": "prometheus"}]},
        "panels": [_panel(number, *panel) for number, panel in enumerate(PANELS)],
    }


def _panel(number: int, title: str, asked: str, unit: str) -> dict[str, Any]:
    return {
        "id": number + 1,
        "type": "timeseries",
        "title": title,
        "datasource": {"type": "prometheus", "uid": "${source}"},
        "gridPos": {
            "x": _WIDE * (number % _IN_A_ROW),
            "y": _HIGH * (number // _IN_A_ROW),
            "w": _WIDE,
            "h": _HIGH,
        },
        "fieldConfig": {"defaults": {"unit": unit}, "overrides": []},
        "targets": [{"refId": "A", "expr": asked}],
    }


if __name__ == "__main__":
    text = json.dumps(dashboard(), indent=2) + "\n"
    Path(__file__).with_name("dashboard.json").write_text(text, encoding="utf-8")
