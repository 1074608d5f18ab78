"""From a capture, its rigs and its alignment to a dataset of shards: what `preface-build-shards` does.

`preface.shards` never imports this package: it needs `preface.capture` and `preface.align`, reading shards does
not. In the order of the work: `people` (whose photographs, by which cameras), `plan` (who goes into which shard,
what it will take), `heads` (photographs become one head), `tasks` (heads become one shard), `schedulers` (tasks
become all shards), `finishing` (the manifest and the dataset's papers).
"""
