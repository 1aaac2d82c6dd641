"""A X = X B over pairs of views: the paper's evolution, the certified optimum and published methods.

The ways in are `pairs`, `paper.solve_paper`, `robust.solve_global` and the functions of `peer_methods`;
everything else is private. Knows poses only, no corners.
"""
