"""The workbench: a web page on which an engineer compares a model with recordings and adds the effects that it lacks.

``session`` holds the work without the page: start with ``session.session``, then ``session.controller``.
``panels`` has the four columns of the page, ``open_dialog`` the dialog that chooses a model and recordings, and
``live`` the page that watches running robots. ``page`` builds one browser tab of the kind that ``tab`` describes;
``server`` serves everything.
"""
