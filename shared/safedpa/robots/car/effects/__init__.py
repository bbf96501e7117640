"""Physical effects that a car model may lack, one per module; ``channels`` is a table of the effects on commands.

To add an effect, copy ``quadratic_drag.py`` and change it; for an effect on a command add a row to ``channels``.
Effects are found by their module: nothing has to be registered or generated.
"""
