"""The adaptation service."""
