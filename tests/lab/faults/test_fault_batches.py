"""Zenoh's byte stream, cut into batches; which of them may be lost."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa_lab.faults.batches import Batches, carries_data

FRAME, FRAGMENT, KEEP_ALIVE, INIT = 0x05, 0x06, 0x04, 0x01
PUSH, REQUEST, RESPONSE, DECLARE, INTEREST, FINAL = 0x1D, 0x1C, 0x1B, 0x1E, 0x19, 0x1A


def batch(*body: int) -> bytes:
    return len(body).to_bytes(2, "little") + bytes(body)


@given(st.lists(st.binary(max_size=400)), st.lists(st.integers(1, 97)))
def test_however_the_stream_is_cut_the_same_batches_come_out(bodies: list[bytes], cuts: list[int]) -> None:
    whole = [len(body).to_bytes(2, "little") + body for body in bodies]
    stream, batches, found = b"".join(whole), Batches(), []
    for cut in cuts:
        found += batches.feed(stream[:cut])
        stream = stream[cut:]
    assert found + batches.feed(stream) == whole


@pytest.mark.parametrize("kind", [PUSH, REQUEST, RESPONSE])
@pytest.mark.parametrize(
    "before",
    [
        (FRAME, 0x03),
        (FRAME | 0x20, 0x83, 0x01),  # reliable, a sequence number of two bytes
        (FRAME | 0x80, 0x03, 0x31, 0x07),  # an extension that is a number: the priority
        (FRAME | 0x80, 0x03, 0xB1, 0x87, 0x01, 0x02),  # two extensions, the second without a body
        (FRAME | 0x80, 0x03, 0x45, 0x02, 0xFF, 0xFF),  # an extension of two bytes
    ],
)
def test_a_frame_of_data_is_recognised_behind_numbers_and_extensions(before: tuple[int, ...], kind: int) -> None:
    assert carries_data(batch(*before, kind, 0x00))
    assert carries_data(batch(*before, kind | 0xE0, 0x00)), "its flags do not matter"
    assert not carries_data(batch(*before, DECLARE, 0x00))


def test_what_a_session_is_made_of_is_never_lost() -> None:
    for body in ((), (KEEP_ALIVE,), (INIT, 0x09), (FRAME,), (FRAME, 0x80), (FRAME | 0x80, 0x01, 0x45, 0x7F)):
        assert not carries_data(batch(*body))
    for kind in (DECLARE, INTEREST, FINAL):
        assert not carries_data(batch(FRAME, 0x03, kind))
    assert carries_data(batch(FRAGMENT, 0x03, 0x00)), "a part of a large message"


@pytest.mark.parametrize("size", [1, 127, 128, 300])
@pytest.mark.parametrize("kind", [PUSH, DECLARE])
def test_data_is_recognised_behind_an_extension_of_many_bytes(size: int, kind: int) -> None:
    """The length is sent seven bits a byte, the lowest first: 300 is 0b0000010 and 0b0101100."""
    length = [size] if size < 128 else [0x80 | size % 128, size // 128]
    body = (FRAME | 0x80, 0x03, 0x45, *length, *[DECLARE if kind == PUSH else PUSH] * size, kind, 0x00)
    assert carries_data(batch(*body)) is (kind == PUSH)
