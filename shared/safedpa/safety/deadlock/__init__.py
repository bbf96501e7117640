"""Robots that do not move although the nominal action asks them to.

Read ``detector`` first (when a robot counts as stationary, and why), then ``escape`` (how the filter leads it out of
the boundary layer of its margin).
"""
