"""The loop that runs a service for any number of robots.

``node`` is the interface that a service implements, ``service_loop`` calls it once per tick and robot and decides when.
``model_versions`` changes models at a common tick, ``handshake`` and ``sandbox`` support that.
``robot_slot`` is the loop's state of one robot, ``service_log`` its events, ``process`` starts and ends a process.
Read ``node.py`` first, then ``service_loop.py``.
"""
