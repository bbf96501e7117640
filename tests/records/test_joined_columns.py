"""Several columns as one, and the slope of any state: columns of logs that an own system needs."""

import numpy as np
import pytest

from safedpa.records import load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.systems import System, Variable

CART = System(
    name="joined_cart",
    state=(Variable("way", "m", -100.0, 100.0), Variable("speed", "m/s", -9.0, 9.0)),
    action=(Variable("throttle", "1", -1.0, 1.0),),
)
HEAD = 'format = 1\nrobot = "joined_cart"\n[columns]\nt = "t"\n'


def log(tmp_path, rows=200):
    t = 0.02 * np.arange(rows)
    way = 0.3 * np.sin(2.0 * t) + 0.8 * t
    left, right = 900.0 * way - 40.0 * t, 1100.0 * way + 40.0 * t
    near, far = np.where(np.arange(rows) % 3 == 0, np.nan, way), way
    drive = np.sin(3.0 * t)
    table = np.column_stack([t, left, right, near, far, 0.6 * drive, 0.8 * drive])
    path = tmp_path / "log.csv"
    np.savetxt(path, table, delimiter=",", header="t,left,right,near,far,u1,u2", comments="", fmt="%.9g")
    return path, t, way, drive


def read(path, columns):
    return load_run(path, CART, parse_column_map(HEAD + columns))


def test_wheels_make_one_way_and_its_slope_a_speed(tmp_path):
    path, t, way, drive = log(tmp_path)
    run = read(
        path,
        'way = { from = ["left", "right"], join = "mean", unit = "mm" }\n'
        'speed = { derive = "slope", of = "way", window = 0.08 }\n'
        'throttle = { from = ["u1", "u2"], join = "norm" }\n',
    )
    (part,) = run.parts()
    np.testing.assert_allclose(part[1][:, 0], np.interp(part[0], t, way), atol=1e-6)
    np.testing.assert_allclose(part[1][:, 1], 0.6 * np.cos(2.0 * part[0]) + 0.8, atol=2e-3)
    np.testing.assert_allclose(part[2][:, 0], np.abs(np.interp(part[0], t, drive)), atol=1e-6)
    assert any("speed is the slope of the measured way over 0.08 s" in item.message for item in run.findings)


@pytest.mark.parametrize(
    ("join", "unit", "wanted"),
    [
        ("sum", "mm", lambda t, way: 2.0 * way),
        ("difference", "mm", lambda t, way: -0.2 * way - 0.08 * t),
    ],
)
def test_each_join_computes_what_its_name_says(tmp_path, join, unit, wanted):
    path, t, way, _ = log(tmp_path)
    text = f'way = {{ from = ["left", "right"], join = "{join}", unit = "{unit}" }}\nspeed = "far"\nthrottle = "u1"\n'
    part = read(path, text).parts()
    for own, states, _ in part:
        np.testing.assert_allclose(states[:, 0], wanted(own, np.interp(own, t, way)), atol=1e-6)


def test_the_first_available_column_fills_gaps(tmp_path):
    path, t, way, _ = log(tmp_path)
    text = 'way = { from = ["near", "far"], join = "first" }\nspeed = { derive = "slope", of = "way", window = 0.1 }\n'
    run = read(path, text + 'throttle = "u1"\n')
    (part,) = run.parts()
    np.testing.assert_allclose(part[1][:, 0], np.interp(part[0], t, way), atol=1e-6)
