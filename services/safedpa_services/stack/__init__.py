"""The stack: adaptation, policy and safety filter in one process, for fleets of many robots; see ``__main__.py``."""
