"""Models of the car: ``kinematic_bicycle`` (base model), ``limits`` (performance, braking) and ``throttle``."""
