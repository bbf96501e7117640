"""A few faults on a real fleet, each shortened: the robot is safe, and drives again."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from safedpa.errors import InputError
from safedpa_lab.faults.campaign import run_faults
from safedpa_lab.faults.fault import Fault
from safedpa_lab.faults.table import all_faults, faults_named, small_faults

pytestmark = pytest.mark.slow


@pytest.mark.long
@pytest.mark.processes
def test_whatever_fails_the_robot_is_safe_and_drives_again(tmp_path: Path) -> None:
    campaign = run_faults(small_faults(), folder=tmp_path, is_hasty=True)
    by_name = {outcome.name: outcome for outcome in campaign.outcomes}
    assert {name: outcome.broken for name, outcome in by_name.items() if not outcome.held} == {}
    assert campaign.recorded >= campaign.acknowledged > 0
    assert by_name["kill safety_filter"].watchdog > 0, "the robot braked by itself while there was no filter"
    assert by_name["stop robot"].periods > 0
    assert by_name["hang safety_filter"].watchdog >= 20, "1.5 s in which the filter lives and does not answer"
    assert by_name["disconnect robot"].watchdog >= 25, "1.5 s without a network"
    assert by_name["change-take adaptation"].fallbacks > 0, "no latent of another model is taken"
    assert sum(outcome.collisions + outcome.stale_actions for outcome in campaign.outcomes) == 0


def test_every_fault_has_a_name_of_its_own_and_is_found_by_it() -> None:
    faults = all_faults()
    assert len({fault.name for fault in faults}) == len(faults) >= 50
    assert [fault.name for fault in faults_named("kill robot")] == ["kill robot"]
    assert len(faults_named("kill")) == 8
    with pytest.raises(InputError, match="did you mean 'kill robot'"):
        faults_named("kill robots")


def test_faults_with_another_diagnosis_are_consecutive() -> None:
    """Else the campaign would begin a new fleet for each."""
    kinds = [fault.diagnosis for fault in all_faults()]
    assert sum(one != other for one, other in itertools.pairwise(kinds)) == 1


@pytest.mark.parametrize("fault", all_faults(), ids=lambda fault: fault.name)
def test_a_fault_says_what_it_does_and_who_looks_on_is_never_noticed(fault: Fault) -> None:
    assert fault.sentence
    target = fault.name.split()[-1]
    if fault.diagnosis == "real" and target in ("diagnosis", "recorder"):
        assert fault.meanwhile == "undisturbed"
