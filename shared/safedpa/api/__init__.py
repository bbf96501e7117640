"""The Python API for notebooks and scripts: what the commands do to logs, models and filters, as functions.

Use it as ``import safedpa``, which imports a name when it is first used. Read ``inputs`` first: what the functions
accept. Then ``comparing``, ``diagnosing``, ``fitting``, ``predicting``, ``planning``, ``calibrating``, ``log_columns``,
``effect_table``, ``robot_check`` and ``exporting``: functions and their results. ``starting`` makes a
first model of the ``recognised_columns`` of a log with the bases of ``proposed_bases``; ``deployment`` prepares a
diagnosed model for driving.
"""
