"""Identifiability: which effects a set of recordings could show, before anything is searched.

Read ``check`` first: it takes seconds and uses the sensitivities of the model along the recordings.
``rehearsal`` simulates the recordings with each effect hidden in them and runs the whole diagnosis: that takes minutes.
"""
