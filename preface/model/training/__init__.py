"""Training: one loop for the prior, inversion and finetuning, and what surrounds it.

`trainer` is the loop, `prior` puts a prior's run together, `checkpoint` and `prior_files` say what is on the disk,
`validation` looks at views that were held out. `configuration` imports no torch, so that ``--help`` is quick.
"""
