"""The README says what is true: its code runs, and links lead somewhere; its commands are tests/docs' affair."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path


def test_the_code_runs_and_corrects_the_wish(repository: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 1
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(blocks[0], "README.md", "exec"), {})
    assert printed.getvalue().startswith("corrected")


def test_every_link_and_picture_is_there(repository: Path) -> None:
    for page in (*sorted(repository.glob("*.md")), *sorted((repository / "docs").glob("*.md"))):
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if not target.startswith(("http://", "https://")):
                assert (page.parent / target).exists(), f"{page.name}: {target}"
