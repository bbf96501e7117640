"""The library: models, effects, filter, diagnosis, adaptation, records, bus. No process, no network at import."""
