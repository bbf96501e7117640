"""The health check for containers: does a service make progress, as observed on the bus? See ``__main__.py``."""
