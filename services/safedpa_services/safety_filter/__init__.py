"""The safety filter service; its node is in ``safedpa.runtime``, the filter itself in ``safedpa.safety``."""
