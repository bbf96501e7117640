"""Attacks on the safety filter, judged by what shares no code with it: grids, linear programs, least squares."""
