"""Starts the processes of one robot's control loop, shows their health, restarts them, and ends all of them.

Read ``plan.py`` first: which processes a loop has, with which options. ``supervisor.py`` runs them as ``child.py``
processes; ``run_monitor.py`` follows the run on the bus and summarises it. ``screen.py``, ``view.py`` and
``log_warnings.py`` show it on a terminal. ``demo_narrator.py`` is the script of ``safedpa demo``.
"""
