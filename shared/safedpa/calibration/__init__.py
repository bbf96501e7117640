"""Calibration of the filter's margins from measurements.

``from_runs`` calibrates on logs of a robot, ``from_recordings`` on recordings of the bus, also by the bound of Theorem
1, and ``from_drives`` on barrier residuals along drives. Read ``from_runs.py`` first. The formula is
``split_conformal_margin`` in ``safedpa.safety.margins.conformal``; the result is a ``MarginCalibration`` of
``safedpa.safety.margins.calibration``.
"""
