"""Into which bundles messages of one moment go: in order, none empty, none larger than one may be or than is read."""

from __future__ import annotations

import pytest

from safedpa.bus.transport.bundle import packed, parts, unbundled

KIB = 1024


@pytest.mark.parametrize(
    ("sizes", "counts"),
    [
        ([], []),
        ([10], [1]),
        ([10] * 256, [256]),
        ([10] * 600, [256, 256, 88]),
        ([24 * KIB - 1] * 4, [2, 2]),  # and a letter of the name each: 48 KiB together
        ([24 * KIB] * 4, [1, 1, 1, 1]),
        ([50 * KIB, 10, 10], [1, 2]),  # what is too large travels alone
        ([10, 50 * KIB, 10], [1, 1, 1]),
        ([50 * KIB], [1]),
    ],
    ids=["none", "one", "256", "600", "48 KiB", "more", "large first", "large between", "large alone"],
)
def test_a_bundle_holds_256_messages_and_48_kib_at_most_and_at_least_one(sizes: list[int], counts: list[int]) -> None:
    entries = [("r", bytes([number % 251]) * size) for number, size in enumerate(sizes)]
    found = list(parts(entries))
    assert [len(part) for part in found] == counts
    assert [entry for part in found for entry in unbundled(packed(part))] == entries
