"""Physical effects that a car model may lack: ``forces`` and ``path`` have a class for each, ``channels`` is a table.

To add an effect, copy ``QuadraticDrag`` in ``forces`` and change it; for one on a command add a row to ``channels``.
The library finds effects by their package: nothing has to be registered or generated.
"""
