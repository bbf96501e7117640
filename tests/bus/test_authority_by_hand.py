"""Whose authority a folder holds, and whether it can be one: what ``_load`` of an ``Authority`` refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from safedpa.bus.security.authority import Authority
from safedpa.errors import InputError


def test_an_authority_whose_key_is_of_another_kind_or_of_another_fleet_is_refused(tmp_path: Path) -> None:
    Authority(tmp_path, "f")
    Authority(tmp_path, "f")
    with pytest.raises(InputError, match="is the authority of fleet 'f', wanted 'g'"):
        Authority(tmp_path, "g")
    other = rsa.generate_private_key(65537, 2048).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (tmp_path / "authority.key.pem").write_bytes(other)
    with pytest.raises(InputError, match="got another kind of key, wanted one on P-256"):
        Authority(tmp_path, "f")
    (tmp_path / "authority.key.pem").write_bytes(b"no key")
    with pytest.raises(InputError, match="no certificate and key of an authority"):
        Authority(tmp_path, "f")
