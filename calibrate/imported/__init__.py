"""Which reading of other people's numbers agrees with the board in their images, or with where they saw it.

Numbers alone allow many: orders of angles, units, order of a quaternion, camera in hand or fixed. Each is
fitted to where the board was, and the evidence decides.
"""

from calibrate.imported.folder import Believed, Given, believe, is_described

__all__ = ["Believed", "Given", "believe", "is_described"]
