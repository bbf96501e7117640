"""The point robot among hazards, in batches; read ``simulation`` (physics) and ``task`` (goals and costs) first.

``body`` holds the constants, ``layout`` draws positions, ``observation`` computes what policies and networks see.
``filtering`` is the safety filter, ``policy_task`` the training task with the teacher of ``route_planner``,
``latent_policy`` the trained policy.
"""
