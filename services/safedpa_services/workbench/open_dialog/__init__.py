"""The dialog that chooses a model, recordings and a column map.

``dialog`` builds it, and shows a column map (``safedpa.records.column_map.form``) as one editable line for each
quantity; ``file_preview`` checks the whole of a recording.
"""
