"""Readers of logs: each reads one file format and returns a ``Table``; read ``table`` first.

``csv`` reads texts in the dialect that ``dialect`` finds, ``parquet`` Parquet files and LeRobot datasets, ``arrays``
NumPy and MATLAB files; ``cells`` converts their cells to numbers. ``bags`` reads logs of ROS and PX4, ``mcap``
recordings of this project's bus. ``mcap_recovery`` reads the records of any MCAP file, also past damage.
"""
