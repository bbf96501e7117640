"""The same filter for many robots at once, over arrays. Read ``filter`` first."""
