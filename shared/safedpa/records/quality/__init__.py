"""Finds defects of a log and cuts the rows with them; nothing is interpolated.

Read ``quality`` first: it runs all checks. ``clock`` checks times, ``values`` single values and units, ``channels``
jumps and frozen signals, and ``consistency`` whether the columns agree. ``findings`` builds the sentences.
"""
