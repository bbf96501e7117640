"""Readers of logs: each reads one file format and returns a ``Table``; read ``table`` first.

``csv`` and ``parquet`` read tables, ``bags`` logs of ROS and PX4, ``mcap`` recordings of this project's bus.
``mcap_recovery`` reads the records of any MCAP file up to its first damage.
"""
