"""Barrier equations of the car; read ``obstacles`` first, then ``body`` for the swept capsule.

``moving_obstacles`` treats movers and hidden areas, ``reverse_odometer`` a towed load. ``pruning`` drops irrelevant
discs, ``batch`` stacks barriers of many cars.
"""
