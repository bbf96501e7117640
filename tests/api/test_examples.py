"""Every public name of ``import safedpa`` has an example that runs, and prints what its docstring says."""

import doctest
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

import safedpa

LONG = ("Diagnosis", "Rehearsal", "SavedDiagnosis", "check", "diagnose", "rehearse")
NAMES = [
    pytest.param(name, marks=pytest.mark.long) if name in LONG else name
    for name in safedpa.__all__
    if name != "__version__"
]


@pytest.mark.parametrize("name", NAMES)
def test_an_example_prints_what_its_docstring_says(name: str, user_folder: Path) -> None:
    names = {"safedpa": safedpa, "np": np}
    examples = doctest.DocTestFinder().find(getattr(safedpa, name), name, module=False, globs=names)
    assert any(found.examples for found in examples), "wanted an example"
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    reported: list[str] = []
    for found in examples:
        runner.run(found, out=reported.append)
    assert not runner.failures, "".join(reported)


def test_each_field_of_a_data_class_is_explained_in_its_help() -> None:
    public = [getattr(safedpa, name) for name in safedpa.__all__]
    for kind in filter(is_dataclass, public):
        missing = [item.name for item in fields(kind) if f"``{item.name}``" not in str(kind.__doc__)]
        assert not missing, kind
