"""The point robot's experiments: baselines, methods, what each believes, its body in MuJoCo as a reference."""
