"""What a router's options make of it: plain text or certificates, who is denied what, and how much."""

import argparse
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ZenohSettings
from safedpa.bus.security.access_control import rate_limits, size_limits
from safedpa.bus.security.certificate_authority import Authority
from safedpa.bus.security.certificates import PemCredentials
from safedpa.bus.service.process import StopSignal
from safedpa.errors import InputError
from safedpa_services.router.__main__ import work


class OpenedError(Exception):
    """In place of a session: the settings with which it would have been opened."""


def settings_of(monkeypatch: pytest.MonkeyPatch, **options: Any) -> ZenohSettings:
    """The settings of a router's session, which is not opened."""

    def opened(settings: ZenohSettings) -> None:
        raise OpenedError(settings)

    monkeypatch.setattr("safedpa_services.router.__main__.capture_zenoh_log", lambda *_: None)
    monkeypatch.setattr("safedpa_services.router.__main__.ZenohTransport", opened)
    usual = {"listen": [], "connect": [], "certificates": None, "card": None, "link": [], "plain": False}
    given = argparse.Namespace(**{"fleet": "f", "robot": ["r1"], "role": "router", **usual, **options})
    with pytest.raises(OpenedError) as caught:
        work(given, StopSignal())
    found: ZenohSettings = caught.value.args[0]
    return found


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, "--listen: got none"),
        ({"listen": ["tls/0.0.0.0:7447"]}, "--certificates: got none"),
        ({"listen": ["tcp/0.0.0.0:7447"], "plain": True, "certificates": Path()}, "--plain: got it together"),
        ({"listen": ["tcp/0.0.0.0:7447"], "plain": True, "card": 9}, "--plain: got it together"),
    ],
)
def test_a_router_without_an_endpoint_or_an_identity_does_not_start(options, sentence, monkeypatch):
    with pytest.raises(InputError, match=sentence):
        settings_of(monkeypatch, **options)


def test_a_router_in_plain_text_denies_no_process_and_limits_sizes_and_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of(monkeypatch, listen=["tcp/0.0.0.0:7447"], connect=["tcp/far:7447"], plain=True)
    assert (settings.mode, settings.listen, settings.connect) == ("router", ("tcp/0.0.0.0:7447",), ("tcp/far:7447",))
    assert (settings.certificates, settings.access) == (None, None)
    assert settings.rates == tuple(rate_limits("f", ["r1"]))
    assert settings.limits == tuple(size_limits("f"))


@pytest.mark.parametrize("by", ["folder", "card", "both"])
def test_a_router_with_certificates_gives_a_revoked_name_no_right(by, tmp_path, monkeypatch):
    """The list of revoked names is in the folder of certificates."""
    monkeypatch.setattr("safedpa.bus.service.process.protect_process_memory", lambda: None)  # of this test's process
    authority = Authority(tmp_path, "f")
    for role in ("router", "policy"):
        authority.issue(role, 1.0)
    (tmp_path / "revoked.txt").write_text("# lost\npolicy\n")
    folder = {"certificates": tmp_path} if by != "card" else {}
    card = {"card": PemCredentials.of(tmp_path, "router").pipe()} if by != "folder" else {}
    links = ["router.west=r1", "router.east"]
    settings = settings_of(monkeypatch, listen=["tls/0.0.0.0:7447"], link=links, **folder, **card)
    assert settings.certificates is not None
    assert settings.access is not None
    assert (settings.rates, settings.limits) == (tuple(rate_limits("f", ["r1"])), tuple(size_limits("f")))
    named = {subject for policy in settings.access["policies"] for subject in policy["subjects"]}
    assert ("policy" in named) is (by == "card")
    assert {"safety_filter", "robot.r1", "router.west", "router.east"} <= named
    brought = {rule["id"]: rule["key_exprs"] for rule in settings.access["rules"]}
    assert brought["router.west brings"] == ["safedpa/f/r1/**", "safedpa/f/-/**"]
    assert brought["router.east brings"] == ["safedpa/f/**"]
