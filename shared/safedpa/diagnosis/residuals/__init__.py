"""Residuals: structure that no effect of the library explains.

Read ``unmodelled`` first: it looks for a region of the floor, then a short formula, then a dependence on one variable.
``weak_sindy`` finds formulas by sparse regression, ``dependence`` computes missing rates and fits a function of one
variable.
"""
