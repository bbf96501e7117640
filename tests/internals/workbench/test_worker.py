"""The background process ends when the process of the page has ended, whatever it is computing."""

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_services.workbench.session import worker


def test_the_process_ends_when_its_parent_has_ended() -> None:
    def reports(report_progress: Any) -> None:
        report_progress(0.5)

    def raise_broken_pipe(_: Any) -> None:
        raise BrokenPipeError

    connection: Any = SimpleNamespace(send=raise_broken_pipe)
    with pytest.raises(BrokenPipeError):
        worker._run(reports, (), connection)
