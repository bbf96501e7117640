"""The process of the safety filter.

Its node is in ``shared/safedpa/runtime``, the filter itself in ``shared/safedpa/safety``.
"""
