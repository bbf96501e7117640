"""The live page: robots on the bus, the findings of their diagnosis, and the user's decisions.

Read ``store`` first: it keeps what was received from each robot. ``links`` fills it from a bus or from a recording.
``panels`` draws its content, and ``page`` builds one browser tab.
"""
