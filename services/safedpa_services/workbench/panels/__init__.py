"""The four columns of the page: prediction, error map, candidates and error reduction.

``elements`` has the building blocks (read it first), ``theme`` the colours and the common figure layout.
``prediction`` and ``error_map`` also hold the functions that build the Plotly figures.
"""
