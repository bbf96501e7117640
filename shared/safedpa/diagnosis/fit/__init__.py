"""Fitting: estimates parameters of effects from windows of recordings, and their error on data that was not fitted.

Read ``multiple_shooting`` first (the windows and their residuals), then ``least_squares`` (the fit) and
``cross_validation`` (the held-out error). ``prediction_error_method`` gives the reported values with the Kalman filter
of ``kalman``. ``data_checks`` selects the window length and decides whether the data suffice.
"""
