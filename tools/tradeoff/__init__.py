"""What ``tools/measure_tradeoff.py`` is made of: points to measure, measuring, choosing among them, telling."""
