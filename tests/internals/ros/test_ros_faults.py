"""How a drive with a fault is judged; the drive itself takes a minute."""

import pytest

from safedpa_lab.experiments.ros.experiment import _judged


@pytest.mark.parametrize(
    ("mark", "collisions", "held"),
    [
        ({"notice": ["r1: gateway: the gateway brakes: no action"], "stood_after": 0.5}, 0, True),
        ({"notice": ["r1: gateway: the gateway brakes: no action"], "stood_after": 0.5}, 1, False),
        ({"notice": ["r1: gateway: the gateway brakes: no action"], "stood_after": None}, 0, False),
        ({"notice": ["r1: something else"], "stood_after": 0.5}, 0, False),
        ({"notice": [], "stood_after": 0.5}, 0, False),
    ],
)
def test_a_fault_is_handled_if_the_car_stops_without_a_collision_and_the_right_part_reports_it(mark, collisions, held):
    whole = {"speed": 1.0, "stopping_way": 0.3, "told_after": 0.1, **mark}
    found = {"mark": whole, "collisions": collisions, "driver_brakes": 0}
    assert _judged("filter killed", 1, found, "the gateway brakes: no action")["held"] is held
