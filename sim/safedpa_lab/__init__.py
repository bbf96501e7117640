"""The laboratory: what the product shows, measured: experiments, benchmarks, faults, hidden effects, baselines.

The product imports nothing of it; its commands join the others by the entry points ``safedpa.commands``.
"""
