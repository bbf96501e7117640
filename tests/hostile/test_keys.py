"""Keys of a run are gone when it is, whichever way it ended; a copy of one and a revoked one are cut off."""

import argparse
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.waiting import until

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.access_control import access_control, roles_of
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates, PemCredentials
from safedpa.bus.service.process import add_bus_options, identity_from_options
from safedpa.errors import BusError
from safedpa_services.router.router import DuplicateCertificates, RevocationList
from safedpa_services.supervisor.certificate_store import ephemeral_certificates
from safedpa_services.supervisor.private_folder import private_folder

_HOLDS = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # who starts the tests in the background has it ignored
from safedpa_services.supervisor.certificate_store import ephemeral_certificates
with ephemeral_certificates("f", "r1") as certificates:
    print(certificates.folder, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSEGV, signal.SIGINT])
def test_the_keys_are_gone_whichever_way_the_run_ends(number: int) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _HOLDS], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as running:
        assert running.stdout is not None
        folder = Path(running.stdout.readline().strip())
        assert [path.name for path in folder.glob("*.key.pem")] == ["operator.key.pem"]
        assert folder.stat().st_mode & 0o077 == 0
        running.send_signal(number)
        running.wait()
        assert until(lambda: not folder.exists())


def test_what_a_killed_machine_left_behind_goes_with_the_next_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with private_folder() as living:
        forgotten = tmp_path / "safedpa-run-forgotten"
        shutil.copytree(living, forgotten)
        (tmp_path / "safedpa-run-of-another-user").mkdir()
        with private_folder() as next_one:
            assert living.exists(), "another run's"
            assert next_one.exists()
            assert not forgotten.exists()
            assert (tmp_path / "safedpa-run-of-another-user").exists(), "not ours: it was never locked"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["safedpa-run-of-another-user"]


def test_no_argument_of_any_process_contains_a_key_or_a_token(tmp_path: Path) -> None:
    """Arguments are everybody's to read; the environment and the files are this user's."""
    from safedpa_services.supervisor.plan import Plan

    plan = Plan(
        robot="car", name="r1", load="none", seconds=1.0, seed=0, rate=20.0, lockstep=False, filtered=True,
        dashboard=True, model="car", settings="car", margin="", controller="", fleet="fleet",
        endpoint="tcp/127.0.0.1:1", folder=tmp_path, diagnosis=True, workbench_port=8080,
    )  # fmt: skip
    children = [*plan.services(), plan.robot_process()]
    assert plan.page_token in plan.workbench_address
    assert any(plan.page_token in child.environment.values() for child in children)
    assert not any(plan.page_token in argument for child in children for argument in child.arguments)
    assert plan.page_token not in repr(plan)


def test_a_process_reads_its_card_once_and_publishes_nothing_of_it() -> None:
    with ephemeral_certificates("f", "r1") as certificates:
        card = certificates.credentials["workbench"]
    parser = argparse.ArgumentParser()
    add_bus_options(parser)
    descriptor = card.pipe()
    options = parser.parse_args(["--role", "workbench", "--card", str(descriptor)])
    assert identity_from_options(options) == card
    assert "PRIVATE" not in repr(card) + repr(certificates) + repr(options)
    assert options.card is None, "options are published on the bus"
    with pytest.raises(BusError, match="--certificates is missing"):
        identity_from_options(options)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)


def test_a_card_where_nothing_is_open_is_refused() -> None:
    """At a number that nothing can have: a number that was closed may be another thread's by now, which reads it."""
    with pytest.raises(BusError, match="Bad file descriptor"):
        PemCredentials.from_descriptor(2**31 - 1, "policy")


_PRIVATE = """
import ctypes, os, sys, time
from safedpa.bus.security.certificates import protect_process_memory
if os.getuid() == 0:  # who may read everything
    os.setuid(65534)
    ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)  # as every process begins
print(protect_process_memory() if sys.argv[1] == "closed" else True, flush=True)
time.sleep(60)
"""
_PRIES = """
import os, sys
if os.getuid() == 0:
    os.setuid(65534)
for name in ("mem", "environ", "maps"):
    try:
        open(f"/proc/{sys.argv[1]}/{name}", "rb").close()
        print(name)
    except PermissionError:
        pass
"""


@pytest.mark.parametrize(("memory", "seen"), [("closed", []), ("open", ["mem", "environ", "maps"])])
def test_a_process_with_a_key_is_not_read_by_others_of_the_same_user(memory: str, seen: list[str]) -> None:
    command = [sys.executable, "-c", _PRIVATE, memory]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as private:
        assert private.stdout is not None
        assert private.stdout.readline() == b"True\n"
        pries = [sys.executable, "-I", "-S", "-c", _PRIES, str(private.pid)]
        found = subprocess.run(pries, capture_output=True, check=True, text=True).stdout
        private.kill()
    assert found.split() == seen


@pytest.fixture
def fleet(tmp_path: Path, free_port: int, links_outlive: None) -> tuple[ZenohTransport, str, Path]:
    folder = tmp_path / "certificates"
    authority = Authority(folder, "fleet")
    for role in roles_of(("r1",)):
        authority.issue(role, 1.0, HOSTS if role == "router" else ())
    endpoint = f"tls/127.0.0.1:{free_port}"
    access = access_control("fleet", ("r1",))
    settings = ZenohSettings("router", (endpoint,), (), Certificates(folder, "router"), access)
    return ZenohTransport(settings), endpoint, folder


def _member(router: ZenohTransport, endpoint: str, folder: Path, role: str) -> ZenohTransport:
    """Joined, and known to the router, which is so a moment later."""
    before = len(router.members())
    found = ZenohTransport(ZenohSettings("client", (), (endpoint,), Certificates(folder, role), connect_timeout=60.0))
    assert until(lambda: len(router.members()) > before)
    return found


@pytest.mark.processes
def test_the_later_one_of_two_with_one_certificate_is_cut_off(fleet: tuple[ZenohTransport, str, Path]) -> None:
    router, endpoint, folder = fleet
    first = _member(router, endpoint, folder, "policy")
    twins = DuplicateCertificates(router.members, router.cut_off)
    for _ in range(9):  # in the first of them it is not known which was there first
        twins.look()
    own = {session for session, name in router.members() if name == "policy"}
    copy = _member(router, endpoint, folder, "policy")
    try:
        for _ in range(4):
            assert own < {session for session, name in router.members() if name == "policy"}
            twins.look()

        def alone() -> bool:  # who is cut off knocks again
            twins.look()
            return {session for session, name in router.members() if name == "policy"} == own

        assert until(alone)
    finally:
        for transport in (copy, first, router):
            transport.close()


@pytest.mark.processes
def test_a_revoked_certificate_s_link_ends(fleet: tuple[ZenohTransport, str, Path], tmp_path: Path) -> None:
    router, endpoint, folder = fleet
    members = [_member(router, endpoint, folder, role) for role in ("policy", "robot.r1")]
    path = tmp_path / "revoked.txt"
    revoked = RevocationList(path, router.members, router.cut_off)
    try:
        assert revoked.look() == 0, "there is no such file"
        path.write_text("# stolen\nrobot.r1\n", encoding="utf-8")
        assert revoked.look() >= 1

        def alone() -> bool:  # who is cut off knocks again, and is cut off again, as the router looks again and again
            revoked.look()
            return [name for _, name in router.members()] == ["policy"]

        assert until(alone)
    finally:
        for transport in (*members, router):
            transport.close()
