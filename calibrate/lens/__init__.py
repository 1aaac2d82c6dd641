"""Intrinsics from a session's own views, and board poses from corners.

The ways in are `intrinsics.calibrate_intrinsics` and `pnp.solve_pnp`;
everything else is private. The lens models themselves are in `calibrate.views.projection`.
"""
