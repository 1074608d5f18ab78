"""From a prior and one to seven views to a head: inversion finds its code, finetuning adapts all weights to it.

`run` puts a fit together, `inversion` and `finetuning` are its two phases, `observations` the views fitted to.
`configuration` imports no torch, so that ``--help`` is quick.
"""
