"""The background process of a page ends when the page's process is gone, whatever it computes then."""

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_services.workbench import worker


def test_a_page_that_is_gone_ends_the_process() -> None:
    def reports(report_progress: Any) -> None:
        report_progress(0.5)

    def gone(_: Any) -> None:
        raise BrokenPipeError

    connection: Any = SimpleNamespace(send=gone)
    with pytest.raises(BrokenPipeError):
        worker._done(reports, (), connection)
