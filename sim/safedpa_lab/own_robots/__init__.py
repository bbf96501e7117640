"""Robots that do not ship: models as a user writes them, and measurements whose hidden effect is known.

Read ``models`` first (ten robots in one file, as for ``--effects``), then ``plants`` (the true robots, which share no
code with the models), ``cases`` (what is hidden in which log).
"""
