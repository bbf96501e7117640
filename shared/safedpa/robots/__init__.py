"""The robots that ship: a folder each, with everything that is theirs alone."""
