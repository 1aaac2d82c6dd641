"""From a recording, or pictures, to a judged calibration: read views, solve, judge by gates, write.

`job.solve_recording` is the whole way, `pictures.solve` the same for arrays. `recorded_views` reads views out
of a recording, `gates` judges, `document` puts the calibration file together. `resource_limits` bounds
time and memory of a solve.
"""
