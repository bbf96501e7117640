"""What is decisions is kept as a file, and comes back from it."""

import asyncio
import json
from dataclasses import replace
from pathlib import Path

import pytest

from safedpa.dynamics import load_model, load_user_file
from safedpa.errors import InputError
from safedpa.robots.car.system import CAR_THROTTLE
from safedpa.systems import Variable
from safedpa.systems.registry import why_not_driven
from safedpa_services.workbench.session.controller import SessionController
from safedpa_services.workbench.session.files import (
    SESSION_FILE,
    SavedSession,
    absolute,
    newest_session,
    read_session,
    session_folder_for,
    write_session,
)
from safedpa_services.workbench.session.inputs import EditedColumnMap, InputSelection

BALL = Path(__file__).parents[2] / "docs" / "examples" / "falling_ball.py"
RETAINED = SavedSession(
    InputSelection(
        "car", ("/a/one.csv", "/a/two.csv"), EditedColumnMap('format = 1\nrobot = "car"\n', "dart_car_columns"), 0.8
    ),
    (("rejected", "payload"), ("added", "quadratic_drag")),
)


@pytest.mark.parametrize("columns", [None, "dart_car_columns", RETAINED.choice.columns])
def test_what_is_written_is_read(tmp_path, columns):
    retained = SavedSession(InputSelection("car", RETAINED.choice.runs, columns, 0.8), RETAINED.decisions)
    write_session(retained, tmp_path)
    assert read_session(tmp_path / SESSION_FILE) == retained


@pytest.mark.parametrize(
    ("change", "phrase"),
    [
        ({"format": 7}, "format = 1"),
        ({"runs": 3}, "TypeError"),
        ({"decisions": [{"do": "forgot", "effect": "x"}]}, "wanted added or removed or rejected"),
        ({"horizon": "soon"}, "ValueError"),
        ({"columns": {"text": "x"}}, "KeyError"),
    ],
)
def test_what_is_no_session_is_refused_in_a_line(tmp_path, change, phrase):
    write_session(RETAINED, tmp_path)
    document = json.loads((tmp_path / SESSION_FILE).read_text(encoding="utf-8")) | change
    (tmp_path / SESSION_FILE).write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(InputError, match=phrase):
        read_session(tmp_path / SESSION_FILE)


def test_another_choice_gets_a_folder_of_its_own_and_the_same_one_goes_on(tmp_path):
    base = tmp_path / "workbench"
    assert session_folder_for(base, RETAINED.choice) == (base, ())
    assert newest_session(base) is None
    write_session(RETAINED, base)
    assert session_folder_for(base, RETAINED.choice) == (base, RETAINED.decisions)
    other = InputSelection("pendulum", ("/a/three.csv",))
    assert session_folder_for(base, other) == (tmp_path / "workbench-2", ())
    write_session(SavedSession(other), tmp_path / "workbench-2")
    assert session_folder_for(base, other) == (tmp_path / "workbench-2", ())
    assert newest_session(base) == tmp_path / "workbench-2" / SESSION_FILE


def test_a_model_without_a_session_file_is_not_overwritten(tmp_path):
    base = tmp_path / "workbench"
    base.mkdir()
    (base / "model.toml").write_text("retained", encoding="utf-8")
    assert session_folder_for(base, RETAINED.choice) == (tmp_path / "workbench-2", ())


def test_paths_become_absolute_and_shipped_names_stay(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.csv").touch()
    assert absolute(InputSelection("car", ("one.csv",))) == InputSelection("car", (str(tmp_path / "one.csv"),))


def test_a_refusal_of_up_names_the_system_and_what_was_wanted():
    thruster = replace(CAR_THROTTLE, action=(Variable("thrust", "N", -1.0, 1.0), CAR_THROTTLE.action[1]))
    notice = why_not_driven(thruster, "car")
    assert "a car with thrust, steer" in notice
    assert "wanted a car with target_speed, steer or throttle, steer" in notice


def test_a_model_that_up_drives_is_not_warned_of_and_another_is(plain, tmp_path):
    controller = SessionController(InputSelection(), tmp_path)
    controller.session = object()
    controller.given = plain
    assert controller.warning == ""
    load_user_file(BALL)
    controller.given = load_model(BALL.with_suffix(".toml"))
    assert "'safedpa up' will refuse it: a ball with" in controller.warning


@pytest.mark.long
@pytest.mark.processes
def test_decisions_are_done_again_after_the_server_died(tmp_path, drives, short_drive, finished):
    choice = InputSelection(str(drives[0]), (str(short_drive),))
    events = []

    async def worked(controller, until):
        controller.add_listener(controller, events.append)
        await controller.open_initial()
        while not until(controller):
            await asyncio.sleep(0.05)

    async def first():
        controller = SessionController(choice, tmp_path / "out")
        await worked(controller, lambda b: b.session is not None and b.session.proposed is not None)
        controller.reject("viscous_drag")
        await controller.add("quadratic_drag")
        controller.close()  # in the middle of the next search
        return [version.error for version in controller.session.versions]

    async def second():
        controller = SessionController(choice, tmp_path / "out")
        await worked(controller, lambda b: b.session is not None and b.session.number > b.session.base - 1)
        controller.session.show_version(0)
        await controller.save()  # the present version, not the one that is looked at
        controller.close()
        return [version.error for version in controller.session.versions], controller.session.decisions

    before = finished(first())
    after, decisions = finished(second())
    assert after == before
    assert [item.name for item in load_model(tmp_path / "out" / "model.toml").effects] == ["quadratic_drag"]
    assert [(do, effect) for do, effect, _ in decisions] == [("rejected", "viscous_drag"), ("added", "quadratic_drag")]
    assert {"opening", "opened", "busy", "candidates", "versions"} <= set(events)
