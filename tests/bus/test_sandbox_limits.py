"""The kernel enforces the sandbox's limits on processor time, memory and files."""

import time
from pathlib import Path

import pytest

from safedpa.bus.service.sandbox import JobProcess

WORKS = """
import os, resource
from pathlib import Path
usual = resource.setrlimit  # a fifth of the processor time
fifth = lambda kind, most: (most[0] // 5,) * 2 if kind == resource.RLIMIT_CPU else most
resource.setrlimit = lambda kind, most: usual(kind, fifth(kind, most))
def spins(work):
    while True: continue
def eats(work): return {"document": str(len(bytes(4 << 30)))}
def dies(work): os.abort()
def writes(work): return {"document": str(Path(work).write_text("x" * 10_000))}
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("function", "phrase"),
    [("spins", "more than 5 s of processor time"), ("eats", ""), ("dies", "ended its process"), ("writes", "")],
)
def test_what_takes_too_much_is_ended(function: str, phrase: str, tmp_path: Path) -> None:
    (tmp_path / "works_apart.py").write_text(WORKS, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        apart = JobProcess(f"works_apart:{function}", lambda: time.monotonic() / 20.0)
    try:
        outcome = apart.submit(str(tmp_path / "file")).outcome(wait=True)
        assert outcome is not None
        assert outcome["problem"]
        assert phrase in outcome["problem"]
        assert not (tmp_path / "file").exists() or (tmp_path / "file").stat().st_size == 0
    finally:
        apart.close()
