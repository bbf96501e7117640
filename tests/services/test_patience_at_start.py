"""How long the supervisor waits for a service that is not heard yet: one that starts slowly is not one that dies."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from safedpa.errors import SafedpaError
from safedpa_services.supervisor import supervisor as module
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.supervisor import Supervisor


class Starting(Child):
    """Lives, and is not heard."""

    pid = 7  # type: ignore[assignment]
    exit_code = None


class Deaf:
    """A watch that hears nobody; each of its turns takes five seconds."""

    def __init__(self) -> None:
        self.health: dict[str, object] = {}
        self.now = 0.0

    def listen(self, wait: float) -> None:
        self.now += 5.0

    def has_hung(self, service: str, pid: int, seconds: float) -> bool:
        return False

    def stop_robot(self) -> bool:
        return False


@pytest.mark.parametrize(("restarts", "waited"), [(0, 125), (1, 35)])
def test_what_still_starts_is_given_more_time_than_what_died(
    restarts: int, waited: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Deaf()
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: watch.now))
    service = Starting("policy", "none", (), tmp_path / "log", restarts=restarts)
    supervisor = Supervisor([service], None, watch, lambda: False, lambda: None)  # type: ignore[arg-type]
    with pytest.raises(SafedpaError, match=f"policy: not ready after {waited} s: it said nothing"):
        supervisor.run()
