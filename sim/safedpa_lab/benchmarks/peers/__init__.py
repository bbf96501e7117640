"""Scripts that run in a peer's own environment: a question on standard input, an answer on standard output."""
