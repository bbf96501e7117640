"""Problems whose constraints are linear in the action, and a judge that solves them without the filter's code.

``problem`` draws random problems, ``judge`` finds their nearest feasible action and compares the filter's with it.
"""
