"""The experiments of ``safedpa experiment``, one a file, each with a click command named ``command``."""
