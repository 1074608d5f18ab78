"""Evaluation: heads rendered at views that they were not fitted to, and held against the photographs.

`views` says which views and which part of them is the face, `figures` measures two images, `evaluate` does both for
a head, `metrics_file` keeps the figures, `tables`, `sheets` and `page` show them. `options` and `metrics_file` import
no torch.
"""
