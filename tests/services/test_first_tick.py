"""The first tick is as fast as any other: a filter imports everything before it reports that it is ready."""

import subprocess
import sys

import pytest

_FIRST_TICK = """
import argparse, sys
from safedpa.bus import LATENT, NOMINAL, LatentMessage, StateMessage, NominalMessage
from safedpa.dynamics import fingerprint, load_model
from safedpa_services.service_factories import add_filter_options, safety_filter
parser = argparse.ArgumentParser()
parser.add_argument("--model")
add_filter_options(parser)
options = parser.parse_args(["--model", sys.argv[1], "--settings", sys.argv[1]])
node, model = safety_filter(options).node, load_model(sys.argv[1])
loaded = set(sys.modules)
actions, states = len(model.system.action), len(model.system.state)
stamp = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
around = {
    "car": {
        "obstacles": ((2.0, 0.1, 0.3),), "field": (-5.0, 5.0, -5.0, 5.0), "footprint": (0.08, 0.4, 0.12),
        "towed": (0.1, 0.3, 0.5) if sys.argv[2] else (),
    },
    "pendulum": {"obstacles": (), "field": (), "footprint": (), "corridor": (-1.0, 1.0)},
}
state = StateMessage(
    **stamp, values=(0.0,) * states, applied=(0.0,) * actions, applied_by="none", period=model.period, lockstep=True,
    goal=(3.0, 0.0), **around[sys.argv[1]],
)
latent = tuple(model.latent.tolist())
node.prepare("r1", state)
node.step("r1", state, {
    LATENT: LatentMessage(**stamp, model=fingerprint(model), values=latent, deviations=latent),
    NOMINAL: NominalMessage(**stamp, values=(1.0,) * actions, controller="test"),
})
print(node.newest("r1") is state, sorted(set(sys.modules) - loaded))
"""


@pytest.mark.long
@pytest.mark.parametrize(("robot", "tows"), [("car", ""), ("car", "tows"), ("pendulum", "")])
def test_the_first_decision_loads_nothing(robot: str, tows: str) -> None:
    """Importing during the tick delays the action: the car's barriers alone take as long as a tick."""
    done = subprocess.run(
        [sys.executable, "-c", _FIRST_TICK, robot, tows], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "True []"
