"""The paper's ablations, repeated: what is varied, the priors for it, the cells' results, and what they say.

`paper` has the paper's own figures, `design` the rows of each table and the fit of each row, `priors` the priors
that some rows need, `cells` what is kept of each fit, `report` the tables and statements. `tools/ablate.py` is the
command.
"""
