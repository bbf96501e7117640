"""What became of each mutant of one module, kept as it comes, and whether it still holds.

A mutant that a test noticed stays noticed as long as the module and the file of that test are the same. One that
survived has survived as long as the module and all files of tests are the same. So a new test costs a trial of what
survived, not of everything.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

__all__ = ["KILLED", "LATER", "SURVIVED", "Kept", "Outcome"]

KILLED, SURVIVED, LATER = "killed", "survived", "later"


@dataclass(frozen=True)
class Outcome:
    """What became of one mutant."""

    name: str
    """Of the mutant."""
    outcome: str
    by: str
    """The test that noticed, as pytest names it; empty where none did, or where that is not known."""
    key: str
    """Of the files on which the outcome rests: where they differ, it says nothing any more."""
    date: str
    commit: str
    """At which it was judged."""


class Kept:
    """The file of outcomes of one module.

    :param path: of that file.
    :param root: of the working tree, from which tests are named.
    :param source: text of the module.
    :param files: of the tests that judge it.
    :param date: today.
    :param commit: of the working tree.
    """

    def __init__(self, path: Path, root: Path, source: str, files: Sequence[Path], date: str, commit: str) -> None:
        self.path = path
        self._root, self._source, self._date, self._commit = root, source, date, commit
        self._whole = _digest(source, *[file.read_text(encoding="utf-8") for file in files])
        self._keys: dict[str, str] = {}

    def all(self) -> dict[str, Outcome]:
        """The last word on every mutant, whether it holds or not."""
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []
        return {entry.name: entry for entry in (Outcome(**json.loads(line)) for line in lines)}

    def valid(self) -> dict[str, Outcome]:
        """What still holds."""
        return {name: entry for name, entry in self.all().items() if entry.key == self._key(entry.outcome, entry.by)}

    def keep(self, name: str, outcome: str, by: str = "") -> str:
        """Writes at once what became of a mutant, so that a run that is cut goes on here; returns the outcome."""
        entry = Outcome(name, outcome, by, self._key(outcome, by), self._date, self._commit)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(entry)) + "\n")
        return outcome

    def _key(self, outcome: str, by: str) -> str:
        test = by.partition("::")[0]
        if outcome != KILLED or not test:
            return self._whole
        if test not in self._keys:
            file = self._root / test
            self._keys[test] = _digest(self._source, file.read_text(encoding="utf-8")) if file.exists() else "gone"
        return self._keys[test]


def _digest(*texts: str) -> str:
    return hashlib.sha256("".join(texts).encode()).hexdigest()[:12]
