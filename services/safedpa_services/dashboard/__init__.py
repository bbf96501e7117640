"""The dashboard service: what happens on the bus, as pictures. Only ``painter`` and ``blueprint`` know Rerun."""
