"""What tests of the training share: networks that were never trained."""

from collections.abc import Callable

import pytest

from safedpa.networks import Weights
from safedpa_sim.training.configuration import Configuration


@pytest.fixture(scope="session")
def untrained() -> Callable[[Configuration], Weights]:
    """Makes networks for a car's configuration: mu gives some z for every environment."""
    return _untrained


def _untrained(configuration: Configuration) -> Weights:
    import torch

    from safedpa_sim.training.networks import AffineNetworks, AffineSizes
    from safedpa_sim.training.simulator import BatchedCars
    from safedpa_sim.training.transitions import scales
    from safedpa_sim.training.weights_export import export_weights

    cars, zeros = BatchedCars(configuration), torch.zeros(configuration.latents)
    vectors = scales(cars, 0) | {"latent_low": zeros - 1, "latent_high": zeros + 1, "latent_nominal": zeros}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        sizes = AffineSizes(3, 4, 2, len(cars.entries), configuration.latents, 8, 8)
        return export_weights(AffineNetworks("car", sizes, vectors), cars, configuration, {})
