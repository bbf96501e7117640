"""The methods that are compared on the point robot: each a policy with its inputs, and a filter or none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

from safedpa_lab.point.plan import COST_LIMIT, LIMITED, Plan
from safedpa_lab.point.shield import FIXED_DIRECTIONS

BASELINE_TITLES: Final = {
    "ppo": "PPO",
    "trpo": "TRPO",
    "ppo_lagrangian": "PPO-Lagrangian",
    "trpo_lagrangian": "TRPO-Lagrangian",
    "cpo": "CPO",
}
FILTERS: Final = {
    "safedpa": "SafeDPA",
    "safedpa_17": "SafeDPA, 17 states",
    **{f"fix_{direction}": f"Fix-{direction}" for direction in FIXED_DIRECTIONS},
    "mix": "Mix",
    "physics": "all but the wind",
    "oracle": "the wind",
}
"""Whose model a filter believes: each has a margin of its own."""
PENALISED: Final = ("rma_p_0_1", "rma_p_0_3", "rma_p_1", "rma_p_3")
"""RMA-P's grid: what a step in a hazard takes off the reward in training."""
SEEKER: Final = "seeker"
REPORTED: Final = {"lidar": "lidar", "latent": "lidar, z", "equal": "z, way, hazards"}


@final
@dataclass(frozen=True)
class Method:
    """One line of the table.

    ``policy``: a learned model's, with that model's phi; or ``seeker``; ``baseline``: the key of a file of
    ``safedpa train-baselines`` in its place; ``filter``: of ``FILTERS``, empty for none.
    """

    name: str
    title: str
    policy: str = "learned"
    filter: str = ""
    baseline: str = ""
    reported: str = REPORTED["equal"]
    """What the policy is given next to its own motion and the goal."""


def _alone(name: str, inputs: str = "lidar", limit: float = COST_LIMIT) -> Method:
    """A baseline in winds, by its inputs and limit."""
    key = Plan(inputs=inputs, limit=limit).key(name, "wind")
    title = BASELINE_TITLES[name] + (f", limit {limit:g}" if name in LIMITED else "")
    return Method(key.replace("_wind", ""), title, policy="", baseline=key, reported=REPORTED[inputs])


def _both(name: str, inputs: str = "lidar") -> Method:
    """The same policy behind SafeDPA's filter."""
    alone = _alone(name, inputs)
    title = f"{alone.title} behind SafeDPA's filter"
    return Method(f"{alone.name}_filtered", title, "", "safedpa", alone.baseline, alone.reported)


_LIDAR: Final = "ppo_lagrangian_wind_latent_1"
"""It heeds the cost, so that the filter has less to change."""
_ALL: Final = (
    Method("safedpa", "SafeDPA", filter="safedpa"),
    Method("safedpa_17", FILTERS["safedpa_17"], filter="safedpa_17"),
    *(Method(name, FILTERS[name], filter=name) for name in FILTERS if name.startswith("fix_")),
    Method("mix", "Mix", filter="mix"),
    Method("physics", "knows all but the wind", filter="physics"),
    Method("oracle", "knows the wind", filter="oracle"),
    Method("safedpa_lidar", "SafeDPA, lidar and z", "", "safedpa", _LIDAR, REPORTED["latent"]),
    Method("unfiltered", "SafeDPA without filter"),
    Method("rma", "RMA", policy="rma"),
    Method("rma_p", "RMA-P", policy="rma_p"),
    *(_alone(name, "equal", 1.0) for name in BASELINE_TITLES),
    *(_alone(name) for name in BASELINE_TITLES),
    *(_alone(name, "lidar", 1.0) for name in LIMITED),
    _both("ppo", "equal"),
    _both("ppo"),
    Method(SEEKER, "goal seeker behind SafeDPA's filter", SEEKER, "safedpa", reported="way by hand"),
)
METHODS: Final = {method.name: method for method in _ALL}
"""By name. ``rma_p`` is the best of ``PENALISED`` on development seeds."""
