"""Faults, one after another, on a fleet of real processes that drives in real time; what each did, in numbers.

A fault is a row of a table: set-up, fault, recovery, invariant (``fault``). The rows are in ``processes``, ``network``,
``resources`` and ``model_changes``; ``campaign`` runs them on a ``world``; ``episode`` judges them by what the robot
itself wrote down and what the world's observer heard. ``proxy`` bends the network; read ``fault`` first.
"""
