"""What a finished loop amounts to, as one JSON document."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safedpa.bus import HealthMessage
from safedpa.errors import SafedpaError
from safedpa.safety.standstill import Stand
from safedpa_services.supervisor.child import Child

__all__ = ["summary_of"]

_UNTOUCHED = ("passed", "disabled", "stopped")


def summary_of(
    robot_summary: Path,
    verdicts: Counter[str],
    children: list[Child],
    health: dict[str, HealthMessage],
    recording: Path,
    standstills: Sequence[Stand] = (),
    others: Mapping[str, Path] | None = None,
) -> dict[str, Any]:
    """The robot's own account, verdicts per status, stands, interventions, services with restarts, and the recording.

    ``others``: by name, where further robots left theirs; they stand under ``robots``.
    Raises SafedpaError when the robot left no account.
    """
    account = _account(robot_summary)
    recorder = health.get("recorder")
    failed = recorder.detail if recorder is not None and recorder.state == "failing" else None
    return {
        **account,
        "verdicts": dict(sorted(verdicts.items())),
        "standstills": list(standstills),
        "interventions": sum(count for status, count in verdicts.items() if status not in _UNTOUCHED),
        "services": [{"name": child.name, "pid": child.pid, "restarts": child.restarts} for child in children],
        "recording": str(recording),
        "recording_error": failed,
        **({"robots": {name: _account(path) for name, path in others.items()}} if others else {}),
    }


def _account(path: Path) -> dict[str, Any]:
    try:
        account: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SafedpaError(f"the robot left no account of its run ({error}); see {path.parent}") from error
    return account
