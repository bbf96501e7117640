"""Live diagnosis of driving robots: monitoring of the model, search for missing effects, and model changes.

``model_monitor`` compares predictions with measurements and raises an alarm; ``finding`` records data after an alarm
and starts a search; ``search_jobs`` is the search as a job for another process. ``change`` replaces the model in all
services of a robot by a two-phase commit; ``versions`` stores what was agreed. ``node`` connects all of it to the bus.
Read ``finding.py`` first, then ``change.py``.
"""
