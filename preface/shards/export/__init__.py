"""Shards in other programs' formats: explicit rays, and nerfstudio's transforms.json.

`preface.shards` never imports this package: writing images needs more than reading shards does.
"""
