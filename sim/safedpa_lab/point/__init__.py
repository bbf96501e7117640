"""The point robot's experiments: baselines, methods, what each believes, its body in MuJoCo as a reference.

``methods`` lists what is compared, ``drivers`` puts a method at the wheel of many robots, ``shield`` is its filter by
a model's ``beliefs``. ``plan``, ``baselines`` and ``trust_region`` train the baselines, ``online_learning`` goes on
behind the filter. ``relinearised`` and ``free_model`` are models that are not affine. Read ``methods`` first.
"""
