"""Writers of runs and recordings."""
