"""Plants faults that developers make at random places of the product and counts those that the tests notice.

``fault_classes`` lists the classes of faults, ``ast_changes`` the changes of the syntax tree that make them.
``working_copy`` runs tests on a copy of the working tree with one fault; ``nearest_tests`` chooses the tests. Run it by
``python -m safedpa_lab.planted_faults``; read ``__main__`` first.
"""
