"""Commands that are struck by signals or run at once, and what has to come of it: ``python -m chaos``."""
