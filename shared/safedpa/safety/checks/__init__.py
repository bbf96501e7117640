"""Checks of a filter before it drives: settings, barriers, backup action and the influence of the actions.

Read ``check_filter`` first (all checks of one filter), then ``barriers`` and ``backup``. ``probes`` chooses the states,
``report`` collects the issues, and ``compatibility`` has the checks that every filter runs when it is made.
"""
