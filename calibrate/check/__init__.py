"""Checks of an installed calibration by later views: the likelihood of the fit, with its posterior as prior.

drift       the test: has the camera moved since
history     drift checks one after the other, and their trend
production  the same test on pictures that are taken anyway
board_now   where a board lies now, for the touch test
same_cell   whether views are of the calibration's cell at all
"""
