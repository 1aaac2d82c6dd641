"""Intrinsics from a session's own views, board poses from corners, and the uncertainty over the image.

The ways in are `intrinsics.calibrate_intrinsics`, `pnp.solve_pnp` and `uncertainty.lens_uncertainty`;
everything else is private. The lens models themselves are in `calibrate.projection`.
"""
