"""Margins on h that cover the model error.

Read ``conformal`` first (the quantile), then ``calibration`` (from one-step errors) and ``online`` (while driving).
"""
