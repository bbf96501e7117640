"""The router: where a secured bus comes together, and where it is enforced who may say what."""
