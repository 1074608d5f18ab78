"""What ``tools/show_demo.py`` is made of: the heads of the demo, its pictures, and what came of each of its stages."""
