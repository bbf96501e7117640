"""What a model lacks: the search for missing effects, their numbers, and how sure they are."""
