"""The robots that ship: a folder each, with everything that is theirs alone."""

__all__ = ["DEFAULT"]

DEFAULT = "car"
"""Which of them is meant where no one says."""
