"""Fixtures of the training tests: untrained networks."""

from collections.abc import Callable

import pytest

from safedpa.networks import Weights
from safedpa_sim.training.configuration import Configuration


@pytest.fixture(scope="session")
def untrained() -> Callable[[Configuration], Weights]:
    """Returns a factory of untrained networks for a car's configuration."""
    return _untrained


def _untrained(configuration: Configuration) -> Weights:
    import torch

    from safedpa_sim.training.data.transitions import scales
    from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
    from safedpa_sim.training.export.weights import export_weights
    from safedpa_sim.training.networks.modules import AffineNetworks, AffineSizes

    cars, zeros = BatchedSimulator(configuration), torch.zeros(configuration.latents)
    vectors = scales(cars, 0) | {"latent_low": zeros - 1, "latent_high": zeros + 1, "latent_nominal": zeros}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        sizes = AffineSizes(3, 4, 2, len(cars.entries), configuration.latents, 8, 8)
        return export_weights(AffineNetworks("car", sizes, vectors), cars, configuration, {})
