"""The tree filter of ``joint`` and ``outward``: ``step`` beside ``docs/explanation/estimator.md``."""
