"""Search: selects the missing effects, marks those that the data cannot tell apart, and finds where they act.

Read ``forward_selection`` first (``run_search``), then ``acceptance`` (thresholds and verdicts) and
``backward_revision`` (exchanges and removals). ``conditional`` lets an effect act only in a region or vary with a
variable; ``conditional_screen`` proposes such laws to first order. ``initial_model`` is the first stage,
``final_parameters`` the last; ``further_trials`` has what is tried if no single effect passes.
"""
