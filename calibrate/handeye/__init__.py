"""One likelihood for everything a cell does not know: X, board, lens, arm, and what each view is worth.

Usable as a library: views in, an estimate out; no files, no pictures. `fit.fit_cell` runs the whole way,
`readings.explain_recording` reads the same views in other ways, `folds.cross_validate` holds the claim
against left-out views.
"""
