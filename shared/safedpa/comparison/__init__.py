"""Comparison of a model with recordings: open-loop rollouts, and errors by state, run, position, speed and time.

Read ``comparison`` first (``compare_model``), then ``windows`` and ``rollout``. ``rollout_error`` defines the error,
``where`` assigns it to ranges of variables, ``summary`` writes sentences and the JSON document. ``actuators`` and
``side_by_side`` make rollouts fast; ``excerpt`` thins recordings, ``output`` chooses folders for results.
"""
