"""The dashboard service: shows a fleet live in a browser, with Rerun.

Read ``dashboard.py`` first: its loop passes messages to ``fleet_view.py``, which turns them into frames of plain shapes
(``shapes.py``), one ``robot_view.py`` per robot. ``rerun_recording.py`` draws the frames; no other module imports
Rerun. ``world.py``, ``pendulum.py``, ``curves.py``, ``histories.py`` and ``now_page.py`` make the shapes of the panes.
"""
