"""Diagnosis next to a driving robot: the watch over its model, findings, and changes of the model."""
