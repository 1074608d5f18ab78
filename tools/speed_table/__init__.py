"""What ``tools/speed_for_accuracy.py`` is made of: keeping measurements, the stages and their rows, Markdown."""
