"""The point robot among hazards: its body in MuJoCo, many of them at once in numpy, the task."""
