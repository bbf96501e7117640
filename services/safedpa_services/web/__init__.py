"""Shared parts of the web servers of dashboard and workbench.

``guard.py`` controls access to a page (token, origin, sizes), ``hosts.py`` checks host names, ``upload_store.py``
limits which files a page may open, ``viewer.py`` provides the files of Rerun's web viewer, ``browser.py`` opens a page.
"""
