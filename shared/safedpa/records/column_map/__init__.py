"""Column maps: names, units and signs of foreign columns. Read ``column_map`` first, then ``apply``."""
