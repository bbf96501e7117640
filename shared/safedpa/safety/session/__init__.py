"""What the filter knows of one robot between ticks, and whether the measured state can be believed.

``filter_session`` is the entry point; ``session_memory`` holds commands, margin, delay and standstill, ``plausibility``
judges each measured state, ``state_limits`` has its thresholds and their file. Read ``filter_session`` first.
"""
