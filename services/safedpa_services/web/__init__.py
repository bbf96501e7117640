"""Shared parts of the web servers of dashboard and workbench.

``page_options.py`` says who may open a page, ``guard.py`` enforces it (token, origin, sizes), ``hosts.py`` checks host
names. ``upload_store.py`` limits which files a page may open, ``viewer.py`` provides the files of Rerun's web viewer,
``ports.py`` chooses a port, ``browser.py`` opens a page.
"""
