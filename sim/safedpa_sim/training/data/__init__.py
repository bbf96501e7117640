"""Training data; read ``transitions`` first.

``transitions`` draws independent single steps, ``drives`` simulates whole drives, and ``sequences`` stores drives with
the rows that the history encoder sees. ``recorded_runs`` loads, checks and splits the recorded runs of phase 3.
"""
