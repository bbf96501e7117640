"""A work session without its page: model versions, candidates, decisions, background jobs and files.

Read ``session`` first (the state), then ``controller`` (the actions that all tabs share). ``inputs`` names what is
opened, ``jobs`` and ``worker`` compute in the background, ``files`` saves. ``selection`` selects windows and computes
the error map; ``candidate_cards`` turns a candidate into text.
"""
