"""Starts the processes of one robot's loop, shows their health, restarts what dies, ends all of them."""
