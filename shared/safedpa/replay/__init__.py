"""Recordings of the bus fed through the real nodes again, and what comes out compared with what was recorded."""
