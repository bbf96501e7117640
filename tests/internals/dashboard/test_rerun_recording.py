"""The end of a recording: pending data are written for at most a second, even if viewers are slow."""

import pytest

from safedpa.dynamics import load_model
from safedpa.safety import FilterSettings
from safedpa_services.dashboard.display_settings import display_settings
from safedpa_services.dashboard.rerun_recording import RerunRecording


class Slow:
    """A stream whose viewers read late, or never."""

    def __init__(self, never: bool) -> None:
        self.never, self.done = never, []

    def flush(self, *, timeout_sec: float) -> None:
        self.done.append(("flush", timeout_sec))
        if self.never:
            raise RuntimeError("timeout")

    def disconnect(self) -> None:
        self.done.append(("disconnect", 0.0))


@pytest.mark.parametrize("never", [False, True])
def test_pending_rows_are_written_first_for_a_second_at_most_and_then_all_is_closed(never: bool) -> None:
    look = display_settings(load_model("car"), FilterSettings.for_robot("car"))
    painter = RerunRecording(look, "fleet", save=None, bind="127.0.0.1", grpc_port=None)
    painter._viewers = stream = Slow(never)
    painter.close()
    assert stream.done == [("flush", 1.0), ("disconnect", 0.0)]
