"""The margin epsilon of each kind of barrier.

Read ``conformal`` first (from errors to a margin with a stated coverage), then ``calibration`` (the file) and
``online`` (one running robot). ``active`` resolves the margins of one decision, ``error_clipping`` leaves out errors
far from the boundary, and ``transition`` ramps from one model's margins to another's.
"""
