"""Services that report another model than the one in force: when they are believed, and how long a repair waits."""

import numpy as np
import pytest
from tests.messages import health_of

from safedpa.bus import HealthMessage
from safedpa.live.change import ModelMismatchMonitor


@pytest.fixture
def state(state_of):
    """state(tick): of the robot's drive number 3, as ``state_of`` makes it."""
    return lambda tick: state_of((tick, np.zeros(4), np.zeros(2)))


def health(tick: int, model: str, service: str = "policy", epoch: int = 3) -> HealthMessage:
    return health_of(service, epoch=epoch, tick=tick, model=model)


@pytest.mark.parametrize(("tick", "believed"), [(100, False), (109, False), (110, True), (500, True)])
def test_a_service_on_another_model_is_believed_ten_ticks_after_a_change(state, tick, believed):
    strays = ModelMismatchMonitor()
    strays.settle(state(100), again=True)
    strays.hear(health(tick, "old"))
    strays.hear(health(tick, "new", "adaptation"))
    assert strays.found("new") == ("policy uses old" if believed else "")
    assert strays.found("new") == "", "reported once for each health message"


def test_health_of_another_drive_or_before_any_state_is_ignored(state):
    strays = ModelMismatchMonitor()
    strays.hear(health(200, "old"))
    assert strays.found("new") == ""
    strays.settle(state(0), again=False)
    strays.hear(health(200, "old", epoch=2))
    assert strays.found("new") == ""
    strays.hear(health(200, "old"))
    assert strays.found("new") == "policy uses old"


def test_a_repair_that_failed_makes_the_next_one_wait_twice_as_long(state):
    strays, waited = ModelMismatchMonitor(), list[int]()
    strays.settle(state(0), again=False)
    for repair in range(5):
        strays.not_corrected()
        if repair == 3:
            strays.corrected()
        count, found = 0, ""
        while not found:
            count += 1
            strays.settle(state(count), again=False)
            strays.hear(health(10_000, "old"))
            found = strays.found("new")
        waited.append(count)
    assert waited == [200, 400, 800, 1600, 200]
