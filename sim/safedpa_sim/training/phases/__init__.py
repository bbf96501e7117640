"""The training phases; read ``phase_1a`` first.

``phase_1a`` trains mu, f and g, ``phase_1b`` the policy, ``phase_2`` the history encoder phi, and ``phase_3`` tunes f,
g and phi on real data in a simulator that these correct. ``sensed_state`` trains the point robot on
its sensor readings instead of its state.
"""
