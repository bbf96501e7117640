"""The experiments of ``safedpa experiment NAME``, one package per subject.

Each package lists its experiments in ``EXPERIMENTS``; ``table`` joins them. ``record`` defines an experiment and its
parameters, ``report`` writes tables, JSON and figures, ``common`` drives and counts, ``run_all`` runs every experiment
whose figures a page quotes.
Read ``record`` first, then ``driving.safety`` as the simplest experiment.
"""
