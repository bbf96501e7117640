"""Training data; read ``transitions`` first.

``transitions`` draws independent single steps, and stores drives with the rows that the history encoder sees.
``drives`` simulates whole drives. ``recorded_runs`` loads, checks and splits the recorded runs of phase 3.
"""
