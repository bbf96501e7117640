"""Diagnosis: finds which effects a model lacks, estimates their parameters and states the uncertainty.

Read ``diagnose`` first: ``diagnose()`` runs all stages and returns the report of ``report_schema``. ``fit`` estimates
parameters from windows of the recordings, ``search`` selects effects, ``residuals`` describes what no effect explains.
``identifiability`` checks beforehand what the recordings can show; ``experiment_design`` proposes the next drive.
``interactive`` offers the same steps one at a time; ``add_effect`` fits one effect that the user names.
"""
