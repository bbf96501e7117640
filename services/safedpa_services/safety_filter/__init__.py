"""The safety_filter service."""
