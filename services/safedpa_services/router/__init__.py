"""The router: connects the processes of a secured bus and enforces access control.

Routing and access control themselves are Zenoh's; the rules come from ``safedpa.bus.security``. Read ``__main__.py``
first. ``router.py`` sends heartbeats, removes duplicate and revoked certificates, and ends a router that hangs;
``refusals.py`` reports refused messages.
"""
