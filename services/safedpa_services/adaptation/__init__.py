"""The adaptation service, which estimates the model's latent; its node is in ``safedpa.adaptation``."""
