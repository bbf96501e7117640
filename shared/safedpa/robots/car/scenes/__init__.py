"""The car's scenes: ``perceived`` builds barriers from each state message, ``sensed`` from perceived surroundings."""
