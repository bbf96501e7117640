"""Whole loops of processes under attack, beside the same loops in peace, measured in the same run."""
