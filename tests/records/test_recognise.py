"""Columns of a body on a plane are recognised by their values."""

import numpy as np
import pytest

from safedpa.records.column_map.recognise import PlanarMotion, logged_column, planar_motion


def test_positions_on_the_floor_follow_from_velocities_of_the_body_and_its_heading() -> None:
    t = 0.02 * np.arange(1500)
    heading, forward, side = 0.4 * t + 0.3 * np.sin(t), 1.0 + 0.5 * np.sin(0.7 * t), 0.4 * np.cos(1.1 * t)
    columns = {
        "side_vel": side,
        "y": 0.02 * np.cumsum(np.sin(heading) * forward + np.cos(heading) * side),
        "heading": heading,
        "x": 0.02 * np.cumsum(np.cos(heading) * forward - np.sin(heading) * side),
        "vel": forward,
    }
    logged = [logged_column(name, values) for name, values in columns.items()]
    assert planar_motion(t, logged) == PlanarMotion("x", "y", "heading", "vel", "side_vel")
    assert planar_motion(t, [item for item in logged if item.name != "heading"]) is None


@pytest.mark.parametrize(
    ("source", "name", "unit", "si"),
    [
        ("velo_m_s", "velo", "m/s", "m/s"),
        ("speedKmH", "speed", "km/h", "m/s"),
        ("gyro_z_rad_s", "gyro_z", "rad/s", "rad/s"),
        ("joint_torque_N_m", "joint_torque", "N m", "N m"),
        ("pos_n_m", "pos_n", "m", "m"),
        ("v_m_per_s", "v", "m/s", "m/s"),
    ],
)
def test_units_of_more_than_one_word_end_a_name(source: str, name: str, unit: str, si: str) -> None:
    column = logged_column(source, np.ones(3))
    assert (column.name, column.unit, column.si) == (name, unit, si)
