"""Loads that the car can tow: square objects on a rigid drawbar, dragged over the floor on feet and runners."""

from __future__ import annotations

from dataclasses import dataclass

from safedpa.errors import InputError, did_you_mean


@dataclass(frozen=True)
class Load:
    """A square load on a drawbar. Sizes and masses are assumed: household objects scaled to a 2.5 kg car."""

    name: str
    mass_ratio: float
    """Mass of the load over mass of the car."""
    deceleration: float
    """m/s2; friction coefficient times gravity."""
    grip: float
    """m/s2; largest lateral force of its runners over its mass. Without runners the chair swings out in fast turns and
    spins the car."""
    side: float
    """m; length and width."""
    drawbar: float = 0.15
    """m from the hitch to the load's near edge; rigid with the load."""

    @property
    def length(self) -> float:
        """Distance from the hitch to the load's centre [m]."""
        return self.drawbar + self.side / 2


LOADS: dict[str, Load] = {
    load.name: load
    for load in (
        Load("box", mass_ratio=0.4, deceleration=2.5, grip=6.0, side=0.25),
        Load("chair", mass_ratio=0.8, deceleration=1.5, grip=6.0, side=0.35),
        Load("large_chair", mass_ratio=1.3, deceleration=1.6, grip=6.0, side=0.45),
    )
}
"""Every load by name; the name ``none`` means driving without a load."""


def load_named(name: str) -> Load | None:
    """Returns the load of that name, None for ``none``. Raises InputError listing the known names."""
    if name == "none":
        return None
    if name not in LOADS:
        raise InputError(f"load '{name}': {did_you_mean(name, ['none', *LOADS])}")
    return LOADS[name]
