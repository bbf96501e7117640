"""Whole loops of processes under attack, next to the same loops in peace, measured in the same run."""
