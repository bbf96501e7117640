"""Simulated robots, their sensors and environments, and the training of learned models on them.

Read ``robots`` first: physics and control loops of the simulated car, pendulum and point robot. ``point`` and
``pendulum`` hold the tasks that policies are trained on, ``sensing`` the simulated laser and people, ``training`` the
training phases. ``closed_loop`` runs a robot with its services in one process, without a bus.

The equations here are the simulated world. Models, their effects and barriers are in ``shared/safedpa``, for the car in
``shared/safedpa/robots/car``.
"""
