"""Constants of Theorem 1, measured: error bound, Lipschitz constants, boundary layer."""
