"""Recordings of the bus fed through the real nodes again, and what comes out held against what was recorded."""
