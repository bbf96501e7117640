"""Transports and the inbox.

``base`` is the interface of a transport, ``zenoh`` and ``memory`` implement it. ``bus`` is what services use: topics
and messages instead of keys and bytes. ``inbox`` holds received messages, bounded in memory, until the loop reads
them. Read ``base.py`` first, then ``bus.py``.
"""
