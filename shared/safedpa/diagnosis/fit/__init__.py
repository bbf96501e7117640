"""Fitting: windows in, the numbers of named effects out, and how well they hold on data that was not fitted."""
