"""The SafeDPA library: robot models, effects, safety filter, adaptation, diagnosis, recordings and message bus.

Importing it starts no process and opens no connection. Read ``safety`` for the filter, ``dynamics`` and ``effects`` for
the models, ``diagnosis`` for the search of missing effects, and ``bus`` for the services. ``robot`` declares a robot.
"""
