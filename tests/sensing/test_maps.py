"""Maps as ROS keeps them: what is occupied is covered, all of it and little more; what is no map is refused."""

import math
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, load_perception, parse_perception
from safedpa.perception.ros_map import PackedCells, read_map
from safedpa.perception.surroundings import closed_discs
from safedpa.perception.zones import HALF_DIAGONAL, Zone

YAML = "image: room.pgm\nresolution: {resolution}\norigin: [{x}, {y}, {yaw}]\nnegate: 0\noccupied_thresh: 0.65\n"
FILE = '[[zones]]\nname = "walls"\nkind = "closed"\nframe = "map"\nmap = "room.yaml"\n'


def written(
    folder: Path, pixels: np.ndarray, resolution: float = 0.05, x: float = 0.0, y: float = 0.0, yaw: float = 0.0
) -> Path:
    """A map's YAML; ``pixels`` (height, width), 0 is occupied, 254 free, 205 unknown."""
    height, width = pixels.shape
    content = f"P5\n# made by hand\n{width} {height}\n255\n".encode() + pixels.astype(np.uint8).tobytes()
    (folder / "room.pgm").write_bytes(content)
    path = folder / "room.yaml"
    path.write_text(YAML.format(resolution=resolution, x=x, y=y, yaw=yaw), encoding="utf-8")
    return path


def corners_of(row: int, column: int, height: int, resolution: float, origin: tuple[float, float, float]) -> np.ndarray:
    """(4, 2) of one pixel, by the documentation of map_server: the origin is the lower left pixel's corner."""
    x, y, yaw = origin
    turned = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    low = np.array([column, height - 1 - row]) * resolution
    own = low + resolution * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    return own @ turned + [x, y]


def covered(places: np.ndarray, discs: np.ndarray) -> np.ndarray:
    apart = np.hypot(places[:, None, 0] - discs[None, :, 0], places[:, None, 1] - discs[None, :, 1])
    return (apart <= discs[None, :, 2] + 1e-9).any(axis=1)


@pytest.mark.long
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10**6), resolution=st.sampled_from([0.02, 0.05, 0.1, 0.13, 0.4]), x=st.floats(-30.0, 30.0),
    y=st.floats(-30.0, 30.0), yaw=st.sampled_from([0.0, 0.0, 0.3, -math.pi / 2, 2.5]),
)  # fmt: skip
def test_all_that_is_occupied_is_covered_and_nothing_far_beyond(tmp_path, seed, resolution, x, y, yaw):
    random = np.random.default_rng(seed)
    pixels = random.choice([0, 254, 205], size=(random.integers(1, 25), random.integers(1, 25)), p=[0.2, 0.6, 0.2])
    pixels[0, 0] = 0
    if seed % 3 == 0:
        pixels[1:9, 1:12] = 0
    zone = Zone("walls", "closed", (), cells=read_map(written(tmp_path, pixels, resolution, x, y, yaw)))
    here = x, y
    reach = 8.0
    discs = closed_discs((zone,), *here, reach)
    share = np.array([[a, b] for a in (0.0, 0.3, 0.5, 0.9, 1.0) for b in (0.0, 0.4, 0.5, 1.0)])
    squares = [corners_of(*at, len(pixels), resolution, (x, y, yaw)) for at in np.argwhere(pixels == 0).tolist()]
    places = np.vstack(
        [one[0] + share[:, :1] * (one[1] - one[0]) + share[:, 1:] * (one[3] - one[0]) for one in squares]
    )
    near = places[np.hypot(*(places - here).T) <= reach]
    assert covered(near, discs).all()
    # a disc reaches beyond the box around a turned pixel by a cell's diagonal, and no farther
    most = 2.0 * HALF_DIAGONAL + 0.5 * resolution * math.sqrt(2.0) * (abs(math.cos(yaw)) + abs(math.sin(yaw)))
    middles = np.array([one.mean(axis=0) for one in squares])
    rim = [disc[:2] + disc[2] * np.array([math.cos(a), math.sin(a)]) for disc in discs for a in np.linspace(0, 6.2, 12)]
    apart = np.array([np.hypot(*(middles - place).T).min() for place in rim])
    assert apart.max() <= most + HALF_DIAGONAL + 1e-6


def test_a_pixel_that_ends_at_a_border_closes_that_cell_alone_and_darkness_is_as_documented(tmp_path: Path) -> None:
    pixels = np.full((4, 4), 254)
    pixels[3, 2:] = 0
    pixels[2, 2:] = 0
    cells = read_map(written(tmp_path, pixels, 0.05, 0.3, -0.7))
    assert cells.corner == (4, -7)
    assert cells.flags.tolist() == [[True]]
    pixels = np.array([[0, 89, 90, 205, 254, 255]])
    path = written(tmp_path, pixels, 0.1)
    assert read_map(path).flags.sum() == 2, "0.65 of 255 is 165.75: darker than 89.25"
    path.write_text(path.read_text(encoding="utf-8").replace("negate: 0", "negate: 1  # bright is a wall"), "utf-8")
    assert read_map(path).flags.sum() == 3


def test_a_file_with_a_map_contains_it_and_perception_reports_its_walls(tmp_path: Path, car_state: None) -> None:
    from safedpa_sim.robots.car.robot import CarRobot
    from safedpa_sim.robots.car.scene import Scene
    from safedpa_sim.sensing import Laser, LaserSettings
    from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

    pixels = np.full((20, 40), 254)
    pixels[:, 30:32] = 0
    written(tmp_path, pixels, 0.05, 0.0, -0.5)
    (tmp_path / "perception.toml").write_text(FILE + "use = true\n", encoding="utf-8")
    own, text = load_perception(tmp_path / "perception.toml")
    assert "room" not in text
    assert parse_perception(text) == own
    scene = Scene(0, None, (-4.0, 4.0, -4.0, 4.0), (), (0.0, 0.0, 0.0))
    state = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings()),))).state_message()
    (message,) = PerceptionNode(own).step("r1", state, {}).values()
    assert message.zones == ("closed walls",)
    assert message.borders == ()
    wall = np.array([[1.5, y] for y in np.linspace(-0.5, 0.49, 30)])
    assert covered(wall, np.array(message.points)).all()


@pytest.fixture
def car_state() -> None:
    pytest.importorskip("pymunk")


@pytest.mark.parametrize(
    ("before", "after", "notice"),
    [
        ("image: room.pgm", "image: none.pgm", "cannot be read"),
        ("image: room.pgm\n", "", "image: missing"),
        ("resolution: 0.05", "resolution: 0", "resolution: got '0', wanted 0.005 to 1"),
        ("resolution: 0.05", "resolution: nan", "resolution: got 'nan'"),
        ("origin: [0.0, 0.0, 0.0]", "origin: [0.0, 0.0]", "wanted [x in m, y in m, yaw in rad]"),
        ("origin: [0.0, 0.0, 0.0]", "origin: [1e9, 0.0, 0.0]", "origin: got '1e9'"),
        ("negate: 0", "negate: yes", "negate: got 'yes'"),
        ("negate: 0", "mode: raw", "mode: got 'raw', wanted trinary"),
        ("negate: 0", "- a: list", "wanted one of image"),
        ("occupied_thresh: 0.65", "occupied_thresh: 1.0", "got no occupied pixel"),
    ],
)
def test_what_is_no_map_is_refused_with_its_file_and_the_key(tmp_path: Path, before: str, after: str, notice: str):
    path = written(tmp_path, np.array([[0, 254], [254, 254]]))
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, after), encoding="utf-8")
    (tmp_path / "perception.toml").write_text(FILE, encoding="utf-8")
    with pytest.raises(InputError) as raised:
        load_perception(tmp_path / "perception.toml")
    assert notice in str(raised.value)
    assert str(tmp_path) in str(raised.value)


@pytest.mark.parametrize(
    ("picture", "notice"),
    [
        (b"P2\n2 2\n255\n0 0 0 0\n", "no binary PGM"),
        (b"\x89PNG", "no binary PGM"),
        (b"P5\n2 2\n65535\n" + bytes(8), "no binary PGM"),
        (b"P5\n2 2\n254\n" + bytes(4), "up to 254"),
        (b"P5\n2 2\n255\n" + bytes(3), "got 3 bytes for 2 x 2 pixels"),
        (b"P5\n0 2\n255\n", "0 x 2 pixels"),
        (b"P5" + b" " * 200_000 + b"x", "no binary PGM"),
        (b"P5\n900000 900000\n255\n", "got 0 bytes"),
    ],
)
def test_a_picture_that_is_none_is_refused_at_once(tmp_path: Path, picture: bytes, notice: str) -> None:
    path = written(tmp_path, np.array([[0]]))
    (tmp_path / "room.pgm").write_bytes(picture)
    with pytest.raises(InputError, match=notice):
        read_map(path)


def test_a_picture_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    path = written(tmp_path, np.array([[0]]))
    (tmp_path / "room.pgm").unlink()
    os.mkfifo(tmp_path / "room.pgm")
    with pytest.raises(InputError, match=r"room\.yaml: .*room\.pgm: is not a regular file"):
        read_map(path)


@pytest.mark.parametrize(("image", "shown"), [("none.pgm", "none.pgm"), (".", "."), ("a\0b", r"a\x00b")])
def test_a_picture_that_cannot_be_read_is_named(tmp_path: Path, image: str, shown: str) -> None:
    path = written(tmp_path, np.array([[0]]))
    path.write_text(path.read_text(encoding="utf-8").replace("room.pgm", image), encoding="utf-8")
    (tmp_path / "perception.toml").write_text(FILE, encoding="utf-8")
    with pytest.raises(InputError) as raised:
        load_perception(tmp_path / "perception.toml")
    assert f"room.yaml: its image '{shown}' cannot be read" in str(raised.value)


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    (tmp_path / "perception.toml").write_text(FILE, encoding="utf-8")
    with pytest.raises(InputError, match=r"room\.yaml: it cannot be read \(No such file"):
        load_perception(tmp_path / "perception.toml")


def test_a_large_picture_that_is_occupied_all_over_takes_no_more_memory_than_some_of_its_rows(tmp_path: Path) -> None:
    path = written(tmp_path, np.zeros((2500, 2000), dtype=np.uint8))
    tracemalloc.start()
    try:
        closed = read_map(path).flags
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()
    assert closed.shape == (1000, 1250)
    assert closed.all()


@pytest.mark.parametrize(
    ("packed", "notice"),
    [
        ("", "no packed cells"),
        ("0 0 2 2 AAAA", "no packed cells"),
        ("0 0 2 2 !!", "no packed cells"),
        ("0 0 0 2 eJxjAAAAAQAB", "wanted 1 to 4000"),
        ("0 0 5000 2 eJxjAAAAAQAB", "wanted 1 to 4000"),
        ("99999999 0 2 2 eJxjAAAAAQAB", "cells away"),
        ("0 0 100 100 eJxjAAAAAQAB", "wanted 1250 of 100 x 100"),
    ],
)
def test_cells_that_were_not_packed_by_us_are_refused(packed: str, notice: str) -> None:
    with pytest.raises(InputError, match=notice):
        PackedCells(packed)


def test_cells_that_unpack_to_more_than_they_say_are_not_unpacked() -> None:
    bomb = PackedCells.of(0, 0, np.zeros((4000, 4000), dtype=np.bool_)).packed.split()
    with pytest.raises(InputError, match="got 2 bytes or more, wanted 1 of 2 x 2"):
        PackedCells(" ".join(("0", "0", "2", "2", bomb[4])))


def test_a_map_is_closed_and_in_the_frame_of_the_map() -> None:
    cells = PackedCells.of(0, 0, np.ones((2, 2), dtype=np.bool_))
    square = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    for more in ({"kind": "ignored"}, {"polygon": square}, {"frame": "robot", "kind": "ignored"}):
        given = {"name": "walls", "kind": "closed", "polygon": (), "cells": cells, **more}
        with pytest.raises(InputError, match="zone walls: got cells of a map"):
            Zone(**given)  # type: ignore[arg-type]
    for text in (FILE.replace('map = "room.yaml"', "map = 3"), '[[zones]]\nname = "a"\nmap = 3\n'):
        with pytest.raises(InputError, match="map: wanted the name of a file"):
            parse_perception(text)


@pytest.mark.long
def test_of_a_large_map_only_what_is_near_is_looked_at() -> None:
    random = np.random.default_rng(0)
    large = PackedCells.of(-2000, -2000, random.random((4000, 4000)) < 0.02)
    part = PackedCells.of(-60, -60, large.flags[1940:2060, 1940:2060])
    for column, row in ((0, 0), (-7, 3)):
        places, layers = large.near(column, row, 50)
        assert 100 < len(places) == len(layers) < 300
        assert np.abs(places - (column, row)).max() <= 50
        assert np.array_equal(places, part.near(column, row, 50)[0])
    for zone in (large, part):
        assert len(zone.near(5000, 0, 50)[0]) == 0
    discs = [closed_discs((Zone("a", "closed", (), cells=cells),), 0.0, 0.0, 4.0) for cells in (large, part)]
    assert np.array_equal(*discs)
