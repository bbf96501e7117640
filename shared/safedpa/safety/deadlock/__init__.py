"""Robots that do not move although a nominal action is given: ``detector`` notices it, ``escape`` leads out."""
