"""The recorder service, which writes every message of a fleet to an MCAP file.

Read ``recorder.py``: ``Recorder`` takes messages from the bus, writes and acknowledges them, and survives a full disk.
``__main__.py`` is the process. The file format itself is in ``safedpa.records``.
"""
