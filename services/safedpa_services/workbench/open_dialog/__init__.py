"""The dialog that chooses a model, recordings and a column map.

``dialog`` builds it. ``column_form`` holds a column map as one editable line for each quantity; ``file_preview``
reads the first rows of a recording and checks the whole of it.
"""
