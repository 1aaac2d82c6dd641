"""Boards: their points, finding them in images to sub-pixel accuracy, and printing them at true scale.

The ways in are `detect.detect`, `model.board_points`, `model.check_board` and `printing.board_sheet`;
everything else is private. Knows no lens, no pose and no recording.
"""
