"""Which pairs of a recording teach a margin: neighbours, under the filter's action, with the latent that it had."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.bus import LATENT as LATENTS
from safedpa.bus import STATE as STATES
from safedpa.bus import LatentMessage, StateMessage
from safedpa.bus.wire.codec import encode
from safedpa.bus.wire.topics import key_of
from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError
from safedpa.records import McapRecorder
from safedpa.safety.drive_heights import DrivenTick
from safedpa.safety.recorded import RecordedTransitions, calibration_from_recordings
from safedpa.safety.shipped import settings_named

CAR = load_model("car")
STAMP = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
STATE = StateMessage(
    **STAMP, values=(0.0, 0.0, 0.0, 1.0), applied=(0.0, 0.0), applied_by="filter", period=0.05, lockstep=False,
    goal=(1.0, 1.0), obstacles=(), field=(-4.0, 4.0, -4.0, 4.0), footprint=(0.1, 0.3, 0.2),
)  # fmt: skip
LATENT = LatentMessage(**STAMP, model="0123456789ab", values=(0.0,), deviations=(0.1,))


def tick(number: int, *, by: str = "filter", adapted: bool = True) -> DrivenTick:
    """The state of a tick is its number, and its latent ten times that; who drove until there."""
    state = replace(STATE, tick=number, values=(float(number), 0.0, 0.0, 1.0), applied=(0.1 * number, 0.0))
    latent = replace(LATENT, tick=number, values=(10.0 * number,)) if adapted else None
    return DrivenTick(replace(state, applied_by=by), latent)


def test_a_transition_holds_what_was_known_before_it_and_what_became_of_it() -> None:
    found = RecordedTransitions([[tick(3), tick(4), tick(5)], [tick(8), tick(9)]])
    assert found.state[:, 0].tolist() == [3.0, 4.0, 8.0]
    assert found.following[:, 0].tolist() == [4.0, 5.0, 9.0]
    np.testing.assert_allclose(found.action[:, 0], [0.4, 0.5, 0.9])  # what led to the second state
    assert found.latent[:, 0].tolist() == [30.0, 40.0, 80.0]
    assert found.drive.tolist() == [0, 0, 1]


def test_where_adaptation_was_silent_the_pair_is_left_out_and_the_others_stay() -> None:
    found = RecordedTransitions([[tick(0), tick(1, adapted=False), tick(2), tick(3)]])
    assert found.state[:, 0].tolist() == [0.0, 2.0]


@pytest.mark.parametrize("by", ["watchdog", "nobody"])
def test_steps_under_another_action_than_the_filters_are_left_out(by: str) -> None:
    found = RecordedTransitions([[tick(0), tick(1, by=by), tick(2)]])
    assert found.state[:, 0].tolist() == [1.0]


def test_over_a_gap_there_is_no_transition() -> None:
    assert RecordedTransitions([[tick(0), tick(2), tick(3)]]).state[:, 0].tolist() == [2.0]


@pytest.mark.parametrize("ticks", [[], [tick(0)], [tick(0, adapted=False), tick(1)], [tick(0), tick(1, by="watchdog")]])
def test_where_none_is_left_it_says_so(ticks: list[DrivenTick]) -> None:
    with pytest.raises(InputError, match="no transition under an action of the filter with a latent"):
        RecordedTransitions([ticks])


def recorded(path: Path, *told: tuple[str, int, int], model: str = "0123456789ab") -> Path:
    """State and latent of each (robot, epoch, tick), in this order; of tick 2 no latent was heard."""
    with McapRecorder(path) as recorder:
        for robot, epoch, number in told:
            state = replace(tick(number).state, epoch=epoch, values=(0.01 * number, 0.0, 0.0, 0.2))
            latent = replace(LATENT, epoch=epoch, tick=number, values=tuple(CAR.latent.tolist()), model=model)
            recorder.write(key_of("fleet", robot, STATES), encode(state), number, number)
            if number != 2:
                recorder.write(key_of("fleet", robot, LATENTS), encode(latent), number, number)
    return path


def test_each_start_of_each_robot_is_a_drive_with_its_ticks_in_order(tmp_path: Path) -> None:
    """Three robots that start twice each, and messages in any order; the fifth drive measures the coverage."""
    told = [(robot, epoch, number) for robot in "abc" for epoch in (7, 8) for number in range(60)]
    mixed = [told[place] for place in np.random.default_rng(0).permutation(len(told)).tolist()]
    path = recorded(tmp_path / "drive.mcap", *mixed, model=fingerprint(CAR))
    made = calibration_from_recordings(CAR, settings_named("car"), [path], 0.5, "2024-01-01")
    assert (made.drives, made.transitions, made.period) == (5, 5 * 59, 0.05)


def test_latents_of_another_model_are_refused(tmp_path: Path) -> None:
    """They have the same numbers, and another meaning: a margin from them would be of neither model."""
    path = recorded(tmp_path / "drive.mcap", ("a", 7, 0), ("a", 7, 1), model="ba9876543210")
    with pytest.raises(
        InputError, match=r"drive\.mcap: latents of model ba9876543210, wanted .*; drive with that model"
    ):
        calibration_from_recordings(CAR, settings_named("car"), [path], 0.5, "2024-01-01")
