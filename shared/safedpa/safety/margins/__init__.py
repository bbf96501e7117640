"""The margin epsilon of each kind of barrier.

Read ``conformal`` first (from errors to a margin with a stated coverage), then ``calibration`` (the
``MarginCalibration`` that a filter loads, and its file) and ``online`` (one running robot). ``safedpa.calibration``
collects the errors from logs, drives and recordings. ``active`` resolves the margins of one decision,
``error_clipping`` leaves out errors far from the boundary, and ``transition`` ramps from one model's margins to
another's.
"""
