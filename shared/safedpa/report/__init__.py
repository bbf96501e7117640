"""Reports: HTML pages, figures, sentences and Rerun recordings of comparisons and diagnoses.

Read ``comparison_page`` and ``diagnosis_page`` first: they fill the templates next to them. ``diagnosis_story``
turns a report document into sentences. ``panels`` builds figures for plotly.js, ``overlays`` and
``comparison_figures`` use it, and ``diagnosis_recording`` writes a recording for the Rerun viewer.
"""
