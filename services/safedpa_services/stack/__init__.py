"""Adaptation, policy and safety filter of many robots in one process."""
