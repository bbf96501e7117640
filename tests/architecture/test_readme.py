"""The README says what is true: its code runs, and links lead somewhere; its commands are tests/docs' affair."""

import json
import re
from pathlib import Path


def test_every_link_and_picture_is_there(repository: Path) -> None:
    for page in (*sorted(repository.glob("*.md")), *sorted((repository / "docs").rglob("*.md"))):
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if not target.startswith(("http://", "https://")):
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_its_figures_are_those_of_the_recorded_experiment(repository: Path) -> None:
    rows = json.loads((repository / "docs" / "evidence" / "results" / "safety.json").read_text(encoding="utf-8"))[
        "rows"
    ]
    drives, hits, without = (
        sum(row[kind][key] for row in rows)
        for kind, key in (("filter_on", "episodes"), ("filter_on", "collisions"), ("filter_off", "collisions"))
    )
    goals = [sum(row[kind]["goals"] for row in rows) for kind in ("filter_on", "filter_off")]
    hit = sum(row["filter_off"]["episodes"] - row["filter_off"]["safe_episodes"] for row in rows)
    assert hits == 0
    readme = " ".join((repository / "README.md").read_text(encoding="utf-8").split())
    assert f"{drives} random drives of 20 s with four loads, no collision with the filter, {without} without" in readme
    claims = (repository / "docs" / "evidence" / "claims.md").read_text(encoding="utf-8")
    assert f"0 in {drives} drives with the filter; {without} in {hit} of {drives} without" in claims
    assert f"{goals[0]} with the filter, {goals[1]} without" in claims
