"""Columns of a body on a plane are recognised by their values."""

import numpy as np

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
