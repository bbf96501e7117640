"""What is said: typed messages, the table of topics, their bytes on the wire."""
