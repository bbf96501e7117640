"""Hostile input against everything that parses: bombs made on purpose, and mutations of what is good."""
