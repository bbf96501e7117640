"""Checks of a filter before it drives: barriers, backup action, controllability. Read ``check_filter`` first."""
