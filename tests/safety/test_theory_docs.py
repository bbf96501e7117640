"""What the README says first is what the page on theory promises, word for word."""

from __future__ import annotations

import re
from pathlib import Path


def test_the_first_sentence_of_the_readme_is_the_promise_of_the_theory(repository: Path) -> None:
    readme = (repository / "README.md").read_text(encoding="utf-8")
    theory = (repository / "docs" / "theory.md").read_text(encoding="utf-8")
    promised = re.search(r"## What is promised\n(?:<!--.*?-->\n)?\n\*\*(.+?)\*\*", theory, re.DOTALL)
    bold = re.search(r"\*\*(.+?)\*\*", readme, re.DOTALL)
    assert promised
    assert bold
    assert " ".join(promised[1].split()) in " ".join(bold[1].split())
    assert "never hit" not in readme
