"""The metrics service: serves the state of a fleet to Prometheus; see ``exporter.py``."""
