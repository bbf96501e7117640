"""What every page that is served here has in common: who may look, under which names, and the viewer's program."""
