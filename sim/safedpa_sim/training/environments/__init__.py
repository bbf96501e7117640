"""Batched environments for training; read ``batched_simulator`` first.

``batched_simulator`` steps thousands of robots at a time. ``policy_task`` is the interface of a task that a policy
learns, ``car_task`` the one of the car with scenes from ``car_scenes``.
``vector_environment`` adapts a task to stable-baselines3.
"""
