"""The simulated car; read ``world`` first.

``world`` is the rigid-body physics with ``actuators``, ``loads``, ``contacts`` and the constants in ``parameters``.
``robot`` adds what a robot does: state messages, watchdog and goals in a ``scene``. ``shared_field`` puts several
cars on one field.
"""
