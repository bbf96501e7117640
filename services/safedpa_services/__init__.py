"""The services, each a process of its own, and the command line ``safedpa``.

Read ``service_main.py`` first: what all services share. ``service_factories.py`` builds the services of the control
loop from their options; each package with a ``__main__.py`` is a process. ``supervisor`` starts and watches the
processes of one loop, ``command_line`` holds the commands, ``dashboard`` and ``workbench`` the pages.
"""
