"""The diagnosis service: monitors the model error of every robot, searches for missing effects, and changes models.

Read ``__main__.py`` first; the diagnosis itself is in ``safedpa.live``. A search runs in a process of its own:
``process_worker.py`` starts it, ``search_worker.py`` is its program, ``work_files.py`` exchanges job and result as
files.
"""
