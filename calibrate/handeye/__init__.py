"""Hand-eye calibration as a library: poses and corners in, X with its uncertainty out; no files, no images.

    import numpy as np
    from calibrate.handeye import SolveOptions, ViewSet, solve_views

    poses = np.load("poses.npz")  # (n, 4, 4) each, n ≥ 4, tilted about two axes; metres
    views = ViewSet.from_poses("eye-in-hand", poses["base_from_flange"], poses["camera_from_board"])
    solution = solve_views(views, SolveOptions(seed=1))
    flange_from_camera, covariance = solution.fit.installed  # (4, 4), (6, 6)
    print(solution.sigma_translation_m, solution.sigma_rotation_rad)
    print(solution.judgement.figures.certificate.certified)
    for view in solution.evidence.views.rejected:
        print(view.index, view.kind, view.reason)

With corners (`Corners`) in each `BoardView` and a camera, the same call also estimates lens, board shape and
arm.
`compare_all` puts the published methods beside it, `view_information` tells what poses would show before
they are recorded. Errors are `calibrate.errors.CalibrationError`s with `code`, `values` and `remedy`.
Everything else is private. Names are loaded at their first use.
To read the code begin with `solve`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
