"""The router: connects the processes of a secured bus and enforces access control.

Routing and access control themselves are Zenoh's; the rules come from ``safedpa.bus.security``. Read ``__main__.py``
first. ``router.py`` sends heartbeats and removes duplicate and revoked certificates, ``refusals.py`` reports refused
messages, and ``watchdog.py`` ends a router that hangs.
"""
