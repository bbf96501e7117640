"""Roles, certificates and access control of a secured bus.

``access_control`` has the table of roles and derives the router's access control from it. ``certificates`` loads the
certificate of a process, ``certificate_authority`` issues them, ``connection_reaper`` closes connections that do not
authenticate in time. Read ``access_control.py`` first.
"""
