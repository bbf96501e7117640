"""Column maps: how the columns of a foreign log become time, states and actions.

Read ``column_map`` first (the data model), then ``apply``. ``file`` reads the TOML format, ``propose`` proposes a map
for a log of topics, ``derive`` differentiates measured signals, and ``units`` lists the units.
"""
