"""A X = X B over pairs of views: the paper's evolution, the certified optimum and published methods.

Public: `pairs`, `paper.solve_paper`, `global_start.solve_global` and the functions of `peer_methods`. Works
on poses only, without corners.
"""
