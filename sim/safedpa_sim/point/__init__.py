"""The point robot among hazards: its body, many of them at once in numpy, the task."""
