"""What takes the place of an accepted effect, and which findings about the base come first."""

from dataclasses import replace

import numpy as np
import pytest

from safedpa.diagnosis.fit.cross_validation import heldout_of
from safedpa.diagnosis.fit.multiple_shooting import shooting_of
from safedpa.diagnosis.identifiability.check import check_identifiability, check_lines
from safedpa.diagnosis.report_schema import Detectable
from safedpa.diagnosis.search.backward_revision import try_all_instead
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.joint_trials import fit_jointly
from safedpa.diagnosis.search.search_state import JudgedTrial
from safedpa.dynamics import AbstractBase, PhysicsModel, Setting
from safedpa.effects import Parameter, general_effects
from safedpa.records.run import Run, Stretch
from safedpa.systems import System, Variable

CART = System("pushed_cart", (Variable("speed", "m/s", -9.0, 9.0),), (Variable("force", "N", -1.0, 1.0),))
EFFECTS = {item.name: item for item in general_effects(CART, moving={"speed": 1.0})}


class Pushed(AbstractBase):
    """d(speed)/dt = gain force."""

    kind = "pushed_cart"
    equation = "d(speed)/dt = gain force"
    source = "Newton"
    system = CART
    parameters = (Parameter("gain", "m/s2/N", 0.1, 20.0, 2.0, neutral=None),)

    def rates(self, state, action, parameters, operations):
        return {"speed": parameters["gain"] * action["force"]}


def model(gain=2.0, free=False):
    return PhysicsModel(Pushed(), (), {"base.gain": Setting(gain, free)}, 0.05)


@pytest.fixture(scope="module")
def runs():
    """Three drives of a cart with a drag of 0.8 1/s and a push of 0.5 m/s2, under random steps of the force."""
    return drives(drag=0.8)


def drives(drag):
    found = []
    for seed in range(3):
        random = np.random.default_rng(seed)
        force = np.repeat(random.uniform(-1.0, 1.0, 40), 15)[:, None]
        t, speed = 0.05 * np.arange(len(force)), np.zeros((len(force), 1))
        for row in range(len(force) - 1):
            end = (2.0 * force[row] + 0.5) / drag
            speed[row + 1] = end + (speed[row] - end) * np.exp(-drag * 0.05)
        noisy = speed + random.normal(0.0, 0.02, speed.shape)
        found.append(Run(f"run_{seed}", CART, t, noisy, force, (Stretch(0, len(t)),), ()))
    return found


def equals_of(runs, names, library):
    search = initial_search(model(), shooting_of(runs, 1.0), heldout_of(runs, 1.0))
    search.library = [EFFECTS[name] for name in library]
    joint = fit_jointly(search, [EFFECTS[name] for name in names])
    search.shooting, search.current, search.error, search.added = joint.shooting, joint.trial, joint.error, list(names)
    found = JudgedTrial(0, joint.trial, 9.0, joint.error, "accepted", "", ())
    search.candidates = [JudgedTrial(0, joint.trial, 9.0, joint.error, "rejected", "", ()), found]
    try_all_instead(search)
    return [item.equals for item in search.candidates]


def test_an_effect_that_does_the_same_in_the_place_of_another_joins_its_group(runs):
    library = ("speed_drag", "speed_push", "force_offset", "speed_friction", "force_lag")
    refused, accepted = equals_of(runs, ("speed_drag", "speed_push"), library)
    assert accepted == ("force_offset",)  # an offset of the force is a push; nothing else is
    assert refused == ()


def test_what_explains_something_else_joins_no_group(runs):
    library = ("speed_drag", "speed_push", "speed_friction", "force_lag", "speed_speed_limit")
    assert equals_of(runs, ("speed_drag", "speed_push"), library)[1] == ()


def test_what_does_the_same_as_a_single_effect_joins_its_group():
    runs = drives(drag=1e-3)
    assert equals_of(runs, ("speed_push",), ("speed_push", "force_offset", "force_lag"))[1] == ("force_offset",)


def test_the_check_reports_a_poor_base_before_what_it_hides(runs):
    found = check_identifiability(model(gain=0.2), runs)
    lines = check_lines(replace(found, sizes=(Detectable("speed_drag", "coefficient", "1/s", None, 0.3, ()),)))
    assert "compared with" in found.poor_base or "of the usual change" in found.poor_base
    assert "The first finding is the base itself" in lines[1]
    assert "or the base hides them" in "\n".join(lines)


def test_a_free_parameter_at_its_bound_is_a_finding_of_the_check(runs):
    backwards = [Run(run.name, CART, run.t, -run.states, run.actions, run.stretches, ()) for run in runs]
    assert "base.gain = 0.1 m/s2/N ended at a bound" in check_identifiability(model(free=True), backwards).poor_base


def test_a_good_base_is_no_finding_of_the_check(runs):
    good = model()
    for name, value in (("speed_drag", 0.8), ("speed_push", 0.5)):
        (parameter,) = EFFECTS[name].parameters
        good = good.with_effect(EFFECTS[name], {parameter.name: Setting(value)})
    found = check_identifiability(good, runs)
    assert found.poor_base == ""
    assert not any("first finding" in line for line in check_lines(found))
