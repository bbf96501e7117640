"""How it travels: Zenoh or memory, and the inbox in which it waits, measured before it is parsed."""
