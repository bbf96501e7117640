"""The pages on safety and on theory do what they say."""

import re
from pathlib import Path
from typing import Any

import pytest

from safedpa.safety import parse_settings

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "".join((DOCS / "guides" / name).read_text(encoding="utf-8") for name in ("safety.md", "margins.md"))


def test_every_example_runs_in_order_and_the_first_is_five_lines_plus_the_users_own(capsys: pytest.CaptureFixture[str]):
    names: dict[str, Any] = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(blocks) == 3
    for number, block in enumerate(blocks):
        exec(compile(block, f"docs/guides/safety.md, block {number}", "exec"), names)
    assert capsys.readouterr().out.startswith("corrected [")
    assert names["verdict"].status.value == "corrected"
    first = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0].splitlines()
    own = [line for line in first if line.startswith(("f =", "g =", "h =", "import numpy"))]
    assert len([line for line in first if line and line not in own]) == 5


@pytest.mark.parametrize("page", ["gymnasium", "barriers"])
def test_the_examples_of_a_page_run_in_order(page: str) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium is an optional extra")
    names: dict[str, Any] = {}
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "guides" / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    for number, block in enumerate(blocks):
        exec(compile(block, f"docs/guides/{page}.md, block {number}", "exec"), names)


def test_the_settings_example_is_read() -> None:
    block = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)[0]
    assert parse_settings(block).epsilon["obstacle"] == 0.012


def test_the_first_sentence_of_the_readme_is_the_promise_of_the_theory(repository: Path) -> None:
    readme = (repository / "README.md").read_text(encoding="utf-8")
    theory = (repository / "docs" / "explanation" / "theory.md").read_text(encoding="utf-8")
    promised = re.search(r"## What is promised\n\n\*\*(.+?)\*\*", theory, re.DOTALL)
    bold = re.search(r"\*\*(.+?)\*\*", readme, re.DOTALL)
    assert promised
    assert bold
    assert " ".join(promised[1].split()) in " ".join(bold[1].split())
    assert "never hit" not in readme
