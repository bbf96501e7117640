"""The simulated car; read ``world`` first.

``world`` is the rigid-body physics with ``actuators``, ``loads``, ``contacts`` and the constants in ``parameters``.
``robot`` adds what a robot does: state messages, watchdog and goals in a ``scene``. ``footprint`` computes the outline
that the filter sees. ``shared_field`` puts several cars on one field, each with the others as ``other_body``.
"""
