"""What no effect of the library explains: on what it depends, and a formula for it."""
