"""``safedpa up --secure``: the loop of one command as it would run over several machines."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.errors import BusError, InputError
from safedpa_services.supervisor.certificate_store import ephemeral_certificates

pytestmark = pytest.mark.processes


@pytest.mark.long
def test_it_drives_and_strangers_stay_outside(network: Any, tmp_path: Path) -> None:
    options = ("--secure", "--headless", "--lockstep", "--seconds", "6", "--json", "--out", str(tmp_path / "runs"))
    command = [sys.executable, "-m", "safedpa_services", "up", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        log = tmp_path / "runs"

        def notice() -> list[dict[str, Any]]:
            lines = [line for path in log.glob("*/router.log") for line in path.read_text().splitlines()]
            return [json.loads(line) for line in lines if line.startswith("{")]

        assert network.until(lambda: any(event["kind"] == "router.open" for event in notice()))
        opened = next(event for event in notice() if event["kind"] == "router.open")
        endpoint = str(opened["sentence"]).split(" on ")[1]
        foreign = ZenohSettings("client", (), (endpoint,), network.card("safety_filter"), connect_timeout=3.0)
        with pytest.raises(BusError, match="could not open"):
            ZenohTransport(foreign)
        output, errors = running.communicate(timeout=180)
    assert running.returncode == 0, errors
    assert json.loads(output)["ticks"] == 120
    kinds = [event["kind"] for event in notice()]
    assert "bus.denied" not in kinds, "everybody may do what he has to do"
    assert "bus.handshake_refused" in kinds


def test_the_certificates_are_gone_afterwards_and_no_more_can_be_made() -> None:
    with ephemeral_certificates("f", "r1") as certificates:
        keys = [path.name for path in certificates.folder.glob("*.key.pem")]
        assert keys == ["operator.key.pem"], "those of processes are handed to them and lie nowhere"
        assert b"PRIVATE KEY" in certificates.credentials["robot.r1"].key
        assert certificates.folder.stat().st_mode & 0o077 == 0
    assert not certificates.folder.exists()
    with pytest.raises(InputError), ephemeral_certificates("f", "*"):
        pass


def test_it_is_for_this_machine_alone() -> None:
    command = [sys.executable, "-m", "safedpa_services", "up", "--secure", "--listen", "tls/0.0.0.0:7447"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "--listen: got it with --secure" in done.stderr
