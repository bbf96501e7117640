"""Keys of a run are gone when it is, whichever way it ended; a copy of one and a revoked one are cut off."""

import argparse
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.access_control import access_control, roles_of
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates, PemCredentials
from safedpa.bus.service.process import add_bus_options, identity_from_options
from safedpa.errors import BusError, InputError
from safedpa_services.router import __main__ as router_process
from safedpa_services.router.refusals import Refusals
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


def until(true: Callable[[], object], seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


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


@pytest.mark.parametrize("notice", [b"", b"-----BEGIN ", b"x" * 100_000, b"-----BEGIN \0-----BEGIN \0x"])
def test_a_card_that_is_none_is_refused(notice: bytes) -> None:
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 1 << 18)
    os.write(writing, notice)
    os.close(writing)
    with pytest.raises(BusError, match="wanted authority, certificate and key"):
        PemCredentials.from_descriptor(reading, "policy")
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(reading)


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


class StartedError(Exception):
    """A router that would have opened its session with ``settings``."""

    def __init__(self, settings: ZenohSettings) -> None:
        super().__init__("started")
        self.settings = settings


@pytest.fixture
def settings_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[argparse.Namespace], ZenohSettings]:
    def opened(settings: ZenohSettings) -> None:
        raise StartedError(settings)

    def settings(options: argparse.Namespace) -> ZenohSettings:
        with pytest.raises(StartedError) as started:
            router_process.work(options, lambda: True)
        return started.value.settings

    monkeypatch.setattr(router_process, "ZenohTransport", opened)
    monkeypatch.setattr(router_process, "capture_zenoh_log", lambda *_: None)
    return settings


Settings = Callable[[argparse.Namespace], ZenohSettings]


def test_a_router_that_starts_gives_a_revoked_name_no_right(tmp_path: Path, settings_of: Settings) -> None:
    authority = Authority(tmp_path, "fleet")
    authority.issue("router", 1.0, HOSTS)
    (tmp_path / router_process.REVOKED).write_text("robot.r1\n", encoding="utf-8")
    settings = settings_of(_router_options(certificates=tmp_path))
    assert settings.access is not None
    with_rights = {subject for policy in settings.access["policies"] for subject in policy["subjects"]}
    assert "robot.r1" not in with_rights
    assert "policy" in with_rights
    assert Refusals().total == 0
    assert os.path.exists(tmp_path / router_process.REVOKED)


@pytest.mark.parametrize("known_by", ["certificates", "card", "both"])
def test_a_router_that_shows_who_it_is_starts_without_any_other_proof(known_by, tmp_path, monkeypatch, settings_of):
    """By a folder of certificates, by a card, or by both: each is enough, and its rights are in force."""
    shown = object()
    monkeypatch.setattr(router_process, "identity_from_options", lambda options: shown)
    options = _router_options(
        certificates=tmp_path if known_by != "card" else None, card=3 if known_by != "certificates" else None
    )
    settings = settings_of(options)
    assert settings.certificates is shown
    assert settings.access is not None
    assert settings.limits
    assert settings.rates


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({}, "--certificates: got none"),
        ({"plain": True, "certificates": Path("certificates")}, "--plain: got it together with --certificates"),
        ({"plain": True, "card": 3}, "--plain: got it together with --certificates"),
        ({"plain": True, "listen": []}, "--listen: got none"),
    ],
)
def test_a_router_is_reachable_and_either_plain_or_shows_who_it_is(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        router_process.work(_router_options(**options), lambda: True)


def test_a_plain_router_limits_sizes_and_rates_all_the_same(settings_of: Settings) -> None:
    settings = settings_of(_router_options(plain=True))
    assert (settings.certificates, settings.access) == (None, None)
    assert settings.limits
    assert settings.rates


def _router_options(**given: Any) -> argparse.Namespace:
    usual = {
        "fleet": "fleet", "listen": ["tls/127.0.0.1:7447"], "connect": [], "certificates": None, "role": "router",
        "robot": ["r1"], "link": [], "plain": False, "card": None,
    }  # fmt: skip
    return argparse.Namespace(**(usual | given))
