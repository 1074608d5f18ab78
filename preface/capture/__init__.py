"""Captures on disk: manifests and their folders, images, boards and rigs. Nothing here knows of faces."""
