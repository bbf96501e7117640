"""The search: which effects are missing, which the data cannot tell apart, and where they act."""
